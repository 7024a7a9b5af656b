"""The promises of the reference text in our own words, and the page that lists each with its tests.

A test covers promises with `@pytest.mark.promise("id", …)`, also within `pytest.param`. `./dev docs` runs

    python tests/reference/promises.py docs/reference-coverage.md
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

TYPES = {
    "pose": "`geometry_msgs` poses (plain, stamped, with covariance) become `Pose`, by `PoseAdapter`.",
    "twist": "`geometry_msgs` twists become `Velocity`, by `TwistAdapter`.",
    "accel": "`geometry_msgs` accelerations become `Acceleration`, by `AccelAdapter`.",
    "vector3": "`geometry_msgs` vectors become `Vector3d`, by `Vector3Adapter`.",
    "point": "`geometry_msgs` points become `Point3d`, by `PointAdapter`.",
    "quaternion": "`geometry_msgs` quaternions become `Quaternion`, by `QuaternionAdapter`.",
    "transform": "`geometry_msgs` transforms become `Transform`, by `TransformAdapter`.",
    "wrench": "`geometry_msgs` wrenches become `ForceTorque`, by `WrenchAdapter`.",
    "odometry": "`nav_msgs/Odometry` becomes `MotionState`, by `OdometryAdapter`.",
    "nmea": "`nmea_msgs/Sentence` becomes `NMEASentence`, by `NMEASentenceAdapter`.",
    "image": "`sensor_msgs/Image` becomes `Image`, by `ImageAdapter`.",
    "compressed-image": "`sensor_msgs/CompressedImage` becomes `CompressedImage`, by `CompressedImageAdapter`.",
    "imu": "`sensor_msgs/Imu` becomes `IMU`, by `IMUAdapter`.",
    "gps": "`sensor_msgs/NavSatFix` becomes `GPS`, by `GPSAdapter`.",
    "gps-status": "`sensor_msgs/NavSatStatus` becomes `GPSStatus`, by `NavSatStatusAdapter`.",
    "camera-info": "`sensor_msgs/CameraInfo` becomes `CameraInfo`, by `CameraInfoAdapter`.",
    "roi": "`sensor_msgs/RegionOfInterest` becomes `ROI`, by `ROIAdapter`.",
    "joint-state": "`sensor_msgs/JointState` becomes `RobotJoint`, by `RobotJointAdapter`.",
    "battery": "`sensor_msgs/BatteryState` becomes `BatteryState`, by `BatteryStateAdapter`.",
    "string": "`std_msgs/String` becomes `String`.",
    "integers": "`std_msgs` signed integers become `Integer8` to `Integer64`.",
    "unsigned": "`std_msgs` unsigned integers become `Unsigned8` to `Unsigned64`.",
    "floats": "`std_msgs` floats become `Floating32` and `Floating64`.",
    "bool": "`std_msgs/Bool` becomes `Boolean`.",
    "tf": "`tf2_msgs/TFMessage` becomes `FrameTransform`, by `FrameTransformAdapter`.",
    "point-cloud": "`sensor_msgs/PointCloud2` becomes `PointCloud2`, by `PointCloudAdapter`.",
}
PROMISES: Mapping[str, Mapping[str, str]] = {
    "Purpose": {
        "write-permission": "An upload needs an API key with at least the permission `write`.",
        "typed-objects": "A message becomes a validated object of an ontology class, not a dictionary.",
    },
    "Loader": {
        "loader-containers": "`ROSLoader` reads `.bag`, `.db3` and `.mcap` through one interface.",
        "loader-globs": "Topic globs such as `/cam/*` select the topics.",
        "loader-ignore": "The policy `IGNORE` skips messages that cannot be decoded.",
        "loader-log-warn": "The policy `LOG_WARN` also logs them.",
        "loader-raise": "The policy `RAISE` stops at the first one.",
        "corrupt-messages": "Corrupt messages do not end a run.",
    },
    "Injector": {
        "server-session": "A run connects to the server and registers the definitions of its configuration.",
        "server-sequence": "It creates a sequence with the given name and metadata.",
        "server-stream": "It converts each message with the adapter of its topic and uploads the rows.",
        "write-buffer": "Rows go through an asynchronous buffer, so that reading and writing overlap.",
        "server-commit": "At the end of the recording, it flushes all buffers and commits the sequence.",
        "progress": "The command line shows the progress of a run.",
        "embedding": "A program runs the injector with a configuration object.",
        "config-shared": "The same settings give the same result from the command line and from a program.",
        "run-raises": "`run()` raises an exception for fatal errors.",
    },
    "Configuration": {
        "config-arguments": "`ROSInjectionConfig` accepts every argument of the documented example.",
        "config-file-path": "`file_path` is the recording.",
        "config-metadata": "`sequence_name` and `metadata` describe the sequence.",
        "config-topics": "`topics` uploads only the topics that match its globs.",
        "db3-needs-distro": "`ros_distro` selects the definitions of standard types for SQLite recordings without definitions.",
        "custom-msgs-run": "`custom_msgs` registers the `.msg` files of a directory before the recording is read.",
        "custom-msgs-names": "Their type names are derived from the package and the file names.",
        "custom-msgs-scope": "An entry with a distro applies to this distro only.",
        "config-override": "`adapter_override` selects the adapter of a topic.",
        "log-level": "`log_level` sets how much a run logs.",
        "on-error-report": "`on_error` with `Report` reports the error and ends the session.",
        "topics-on-error-raise": "`topics_on_error` with `Raise` raises the error of a topic.",
    },
    "Adapters": {
        "adapter-abstract": "`ROSAdapterBase` is an abstract base class.",
        "unwrapping": "Built-in adapters unwrap nested messages, such as a pose with covariance and stamp.",
        "bridge-registry": "`ROSBridge` maps message types to default adapters.",
        "adapter-custom": "A subclass with `ros_msgtype`, an ontology type and `from_dict` converts a new type.",
        "adapter-register": "`@register_default_adapter` makes it the default for its type on all topics.",
        "adapter-types": "`ros_msgtype` is one type or a tuple of types.",
        "adapter-translate": "`translate` receives the message with topic and time, and an override may add steps around the base method.",
        "adapter-schema-metadata": "`schema_metadata` returns metadata of a sensor, which is stored with the topic.",
        "override-topic": "An override applies to its topic; other topics of the type keep the default adapter.",
    },
    "Command line": {
        "cli-help": "`-h` lists all options.",
        "cli-basic": "A path and `--name` are enough for a run.",
        "cli-options": "`--topics` takes several globs, `--metadata` a JSON file, `--ros-distro` a distro.",
    },
    "Type registry": {
        "registry-shared": "One registry is shared by all loaders and injectors of the process.",
        "registry-loader": "Registered types make messages of SQLite recordings readable.",
        "registry-isolation": "Definitions of different distros stay separate, such as the `Header` of ROS 1 and ROS 2.",
        "registry-scopes": "A type is registered for all distros or for one.",
        "registry-register": "`register` takes the path of a `.msg` file or the text of the definition.",
        "registry-directory": "`register_directory` registers every `.msg` file of a directory under the package's name.",
        "registry-cascade": "`get_types` returns the types for all distros, overlaid by those of the given distro.",
        "registry-reset": "`reset` removes all registered types.",
        "registry-preload": "Types that a program registers at its start need no `custom_msgs`.",
    },
    "Validation": {
        "validated-containers": "Recordings are converted alike from every container, in CDR and in the ROS 1 serialization.",
        "r2b-2024": "The sequences of NVIDIA's R2B data set 2024 are ingested ([stand-ins](r2b.md); the originals were not tested).",
        "r2b-no-adapter": "Their topics without an adapter do not prevent this.",
        "r2b-results": "Savings and times are measured for each sequence (stand-ins).",
        "no-adapter": "A topic without an adapter does not prevent the conversion of the recording.",
    },
    "Known issues": {
        "r2b-2023": "The sequences of 2023, which the official bridge cannot read, are ingested (stand-ins).",
        "trailing-bytes": "Payloads longer than their message, which the reader of the official SDK refuses, are decoded.",
    },
    "Models of this module": {
        "model-frame-transform": "`FrameTransform` contains a list of `Transform`.",
        "model-battery-state": "`BatteryState` has the measurements, the health, technology and status of the supply, and its cells.",
        "model-point-cloud": "`PointCloud2` has the layout, the byte order and the binary data; `PointField` describes a channel.",
        "models-serializable": "The three models are `Serializable`.",
    },
    "Message types": {f"type-{name}": sentence for name, sentence in TYPES.items()},
}
_HEAD = """\
# Coverage of the reference

After reading this page, you know which promises of the documentation of the official ROS bridge this project keeps, and
which test proves each. `./dev docs` generates the page from the markers `promise` of the tests. If the documentation is
available, `tests/reference/test_text.py` also runs its programs, commands and tables as they are.

Differences from the official bridge are listed in [migration.md](migration.md#differences).
"""


def marked_tests(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the id of each marker and its test, as path and name."""
    for path in sorted(folder.rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if "mark.promise(" not in text:
            continue
        for function in ast.walk(ast.parse(text)):
            if isinstance(function, ast.FunctionDef) and function.name.startswith("test_"):
                for promise in sorted(_ids(function)):
                    yield promise, f"{path.relative_to(ROOT).as_posix()}::{function.name}"


def _ids(function: ast.FunctionDef) -> Iterator[str]:
    calls = (node for decorator in function.decorator_list for node in ast.walk(decorator))
    for call in calls:
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.promise":
            yield from (str(ast.literal_eval(argument)) for argument in call.args)


def coverage(folder: Path = ROOT / "tests") -> dict[str, list[str]]:
    """Return the tests of each marked promise."""
    tests: dict[str, list[str]] = defaultdict(list)
    for promise, test in marked_tests(folder):
        tests[promise].append(test)
    return dict(tests)


def page() -> str:
    """Return the text of the page."""
    tests = coverage()
    lines = [_HEAD]
    for section, promises in PROMISES.items():
        lines += [f"## {section}", "", "| promise | tests |", "|---|---|"]
        lines += [
            f"| {sentence} | {'<br>'.join(_link(test) for test in tests.get(promise, []))} |"
            for promise, sentence in promises.items()
        ]
        lines.append("")
    return "\n".join(lines)


def _link(test: str) -> str:
    path, name = test.split("::")
    return f"[{name}](../{path})"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
