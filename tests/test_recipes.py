"""docs/recipes.md: lint accepts each manifest, plan finds no error, and the run stores the documented values."""

from __future__ import annotations

import io
import re
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from made_recordings import define, record
from mcap.writer import Writer
from PIL import Image

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import Stores
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "recipes.md").read_text(encoding="utf-8")
SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
WHEEL = "float64 rpm\nstring side\n"
EVENTS = "name,start,end,weather\nturn,+2s,+4s,sunny\nstop,+10s,+11s,rain\n"

Messages = list[tuple[str, Any, int, dict[str, Any]]]
Check = Callable[[Store], None]


def recipes() -> dict[str, list[str]]:
    """Return the YAML blocks of each question."""
    sections = re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]
    return {each.splitlines()[0]: re.findall(r"```yaml\n(.*?)```", each, re.DOTALL) for each in sections}


def header(at_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": at_ns // SECOND, "nanosec": at_ns % SECOND}, "frame_id": frame}


def transform(parent: str, child: str, at_ns: int) -> dict[str, Any]:
    pose = {
        "translation": {"x": 1.0, "y": 0.0, "z": 0.0},
        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    return {"transforms": [{"header": header(at_ns, parent), "child_frame_id": child, "transform": pose}]}


def imu(at: int, at_ns: int) -> dict[str, Any]:
    vector = {"x": float(at), "y": 0.0, "z": 9.81}
    covariance = [0.0] * 9
    return {
        "header": header(at_ns - SECOND // 20, "imu"),
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, "orientation_covariance": covariance,
        "angular_velocity": vector, "angular_velocity_covariance": covariance,
        "linear_acceleration": vector, "linear_acceleration_covariance": covariance,
    }  # fmt: skip


def picture(at: int, at_ns: int) -> dict[str, Any]:
    pixels = np.full((32, 64, 3), (5 * at, 120, 200), np.uint8)
    size = {"height": 32, "width": 64, "step": 192, "encoding": "rgb8", "is_bigendian": 0}
    return {"header": header(at_ns, "camera"), **size, "data": pixels.tobytes()}


def fix(at: int, at_ns: int) -> dict[str, Any]:
    position = {"latitude": 48 + at * 0.001, "longitude": 11.0, "altitude": 500.0}
    covariance = {"position_covariance": [1.0] + [0.0] * 8, "position_covariance_type": 2}
    return {"header": header(at_ns, "gps"), "status": {"status": 0, "service": 1}, **position, **covariance}


def joints(at: int, at_ns: int) -> dict[str, Any]:
    """Return the positions of two joints, whose order changes, and of none in the last message."""
    names = [] if at == 19 else ["elbow", "shoulder"] if at % 2 else ["shoulder", "elbow"]
    position = [at + 0.5 * (name == "elbow") for name in names]
    return {"header": header(at_ns, "arm"), "name": names, "position": position, "velocity": [], "effort": []}


def status(at: int, at_ns: int) -> dict[str, Any]:
    """Return the diagnostics of a motor, and in every other message those of a battery, the last of which is an error."""
    motor = {"level": 0, "name": "motor", "message": "", "hardware_id": "", "values": []}
    values = [{"key": "cells", "value": "12"}, {"key": "voltage", "value": f"{24 + at / 10}"}]
    battery = {**motor, "level": 2 * (at == 18), "name": "battery", "values": values}
    return {"header": header(at_ns, ""), "status": [motor] if at % 2 else [motor, battery]}


def drive() -> Messages:
    """Return 20 seconds of a small robot."""
    resolver = TypeResolver(Stores.LATEST)
    standard = {
        name: resolver.resolve(name, None, ros_version=2)
        for name in (
            "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image", "sensor_msgs/msg/NavSatFix", "std_msgs/msg/String", "tf2_msgs/msg/TFMessage",
            "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray",
        )
    }  # fmt: skip
    imu_type, image, gps, text, tf, joint_state, diagnostics = standard.values()
    wheel = define("acme_msgs/msg/Wheel", WHEEL)
    messages: Messages = [("/tf_static", tf, START_NS, transform("base", "imu", START_NS))]
    for at in range(200):
        at_ns = START_NS + at * SECOND // 10
        messages.append(("/imu", imu_type, at_ns, imu(at, at_ns)))
        if at % 5 == 0:
            messages.append(("/camera/image_raw", image, at_ns, picture(at // 5, at_ns)))
            frames = ("map", "odom") if at % 10 else ("odom", "base")
            messages.append(("/tf", tf, at_ns, transform(*frames, at_ns)))
        if at % 10 == 0:
            messages.append(("/camera/debug", image, at_ns, picture(0, at_ns)))
            messages.append(("/gps/fix", gps, at_ns, fix(at // 10, at_ns)))
            messages.append(("/wheel", wheel, at_ns, {"rpm": float(at), "side": "left"}))
            messages.append(("/wheel/rear", wheel, at_ns, {"rpm": float(at), "side": "rear"}))
            messages.append(("/joint_states", joint_state, at_ns, joints(at // 10, at_ns)))
            messages.append(("/diagnostics", diagnostics, at_ns, status(at // 10, at_ns)))
            messages.append(("/robot/mode", text, at_ns, {"data": "drive" if at // 10 % 8 >= 4 else "idle"}))
    return messages


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the files that the manifests name."""
    folder = tmp_path_factory.mktemp("recipes")
    messages = drive()
    (folder / "events.csv").write_text(EVENTS)
    (folder / "acme_msgs").mkdir()
    (folder / "acme_msgs" / "Wheel.msg").write_text(WHEEL)
    for _, *adapters in recipes().values():
        for text in adapters:
            (folder / text.partition("\n")[0].removeprefix("# ")).write_text(text)
    record(folder / "drive.mcap", messages)
    for name in ("splits", "fleet"):
        (folder / name).mkdir()
    record(folder / "splits" / "night_0.mcap", messages[: len(messages) // 2])
    record(folder / "splits" / "night_1.mcap", messages[len(messages) // 2 :])
    record(folder / "front.mcap", [each for each in messages if each[0] == "/imu"])
    record(folder / "rear.mcap", [each for each in messages if each[0] == "/gps/fix"])
    imus = [each for each in messages if each[0] == "/imu"]
    record(folder / "dropout.mcap", imus[:50] + imus[60:])
    record(folder / "old.db3", [each for each in messages if each[0] in {"/imu", "/wheel"}])
    with closing(sqlite3.connect(folder / "old.db3")) as database:
        database.execute("DROP TABLE IF EXISTS message_definitions")
        database.commit()
    data = record(folder / "truncated.mcap", random_pictures(messages)).read_bytes()
    (folder / "truncated.mcap").write_bytes(data[: len(data) * 4 // 5])
    for robot in (7, 8):
        write_counts(folder / "fleet" / f"robot{robot}_20260301.mcap", {"serial": f"A-{robot}"})
    write_counts(folder / "damaged.mcap", {}, damaged=2)
    write_counts(
        folder / "attached.mcap",
        {"serial": "A-7"},
        attachments={"camera.yaml": b"fx: 500", "log.txt": b"started"},
    )
    return folder


def random_pictures(messages: Messages) -> Messages:
    """Return the messages with large pictures that cannot be compressed, so that the recording has many chunks."""
    random = np.random.default_rng(1)
    size = {"height": 240, "width": 320, "step": 960}
    return [
        (
            topic,
            kind,
            at_ns,
            {**values, **size, "data": random.bytes(240 * 960)} if "step" in values else values,
        )
        for topic, kind, at_ns, values in messages
    ]


def write_counts(
    path: Path,
    vehicle: dict[str, str],
    *,
    damaged: int | None = None,
    attachments: Mapping[str, bytes] = MappingProxyType({}),
) -> None:
    """Write five numbers, one of which can be truncated."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data\n")
        channel = writer.register_channel("/count", "cdr", schema)
        for number in range(5):
            payload = b"\0\1\0\0" + number.to_bytes(4, "little")[: 2 if number == damaged else 4]
            writer.add_message(channel, START_NS + number, payload, START_NS + number)
        if vehicle:
            writer.add_metadata("vehicle", vehicle)
        for name, content in attachments.items():
            writer.add_attachment(START_NS, START_NS, name, "text/plain", content)
        writer.finish()


def rows(store: Store, sequence: str, topic: str) -> list[dict[str, Any]]:
    return store.topic(sequence, topic).to_arrow().to_pylist()


def seconds(store: Store, sequence: str, topic: str) -> list[float]:
    return [(row["timestamp_ns"] - START_NS) / SECOND for row in rows(store, sequence, topic)]


def topics(store: Store, sequence: str) -> dict[str, int]:
    info = store.sequence(sequence)
    assert info is not None
    return {topic.name: topic.rows for topic in info.topics}


def names(store: Store) -> list[str]:
    return sorted(info.name for info in store.sequences())


def check_part(store: Store) -> None:
    assert seconds(store, "part", "/imu") == [at / 10 for at in range(50, 100)]
    assert seconds(store, "part", "/tf_static") == [0]


def check_split(store: Store) -> None:
    assert names(store) == [f"drive_{part:03}" for part in range(1, 5)]
    assert [topics(store, name)["/imu"] for name in names(store)] == [50] * 4
    assert [topics(store, name)["/tf_static"] for name in names(store)] == [1] * 4


def check_events(store: Store) -> None:
    assert names(store) == ["drive_stop", "drive_turn"]
    assert seconds(store, "drive_turn", "/imu") == [at / 10 for at in range(20, 40)]
    info = store.sequence("drive_stop")
    assert info is not None
    assert info.metadata["weather"] == "rain"


def check_stamps(store: Store) -> None:
    assert seconds(store, "sensor_time", "/imu") == pytest.approx([at / 10 - 0.05 for at in range(200)])
    assert seconds(store, "sensor_time", "/wheel") == list(range(20))


def check_shifted(store: Store) -> None:
    assert seconds(store, "shifted", "/imu") == pytest.approx([at / 10 - 0.25 for at in range(200)])


def check_selected(store: Store) -> None:
    assert topics(store, "selected") == {"/camera/image_raw": 40, "/imu": 200}


def check_renamed(store: Store) -> None:
    assert topics(store, "renamed") == {"/robot_7/gps": 20, "/robot_7/imu": 200}


def check_reduced(store: Store) -> None:
    assert seconds(store, "reduced", "/imu") == [at / 2 for at in range(40)]
    assert seconds(store, "reduced", "/camera/image_raw") == [at * 2 for at in range(10)]


def check_transforms(store: Store) -> None:
    stored = [row["transforms"][0]["header"]["frame_id"] for row in rows(store, "without_map", "/tf")]
    assert stored == ["odom"] * 20
    assert topics(store, "without_map")["/tf_static"] == 1


def check_modes(store: Store) -> None:
    values = [(row["timestamp_ns"] - START_NS) // SECOND for row in rows(store, "modes", "/robot/mode")]
    assert values == [0, 4, 8, 12, 16]


def check_splits(store: Store) -> None:
    assert len(names(store)) == 1
    assert [row["acceleration"]["x"] for row in rows(store, names(store)[0], "/imu")] == list(range(200))


def check_merged(store: Store) -> None:
    assert topics(store, "merged") == {"/gps/fix": 20, "/imu": 200}


def check_old(store: Store) -> None:
    assert [row["rpm"] for row in rows(store, "old", "/wheel")] == list(range(0, 200, 10))
    assert topics(store, "old")["/imu"] == 200


def check_saved(store: Store) -> None:
    assert 20 < topics(store, "saved")["/imu"] < 180


def check_fleet(store: Store) -> None:
    assert names(store) == ["fleet_robot7_20260301", "fleet_robot8_20260301"]


def check_wheels(store: Store) -> None:
    stored = rows(store, "wheels", "/wheel")
    assert [row["speed"] for row in stored] == pytest.approx([at * 2 * np.pi / 6 for at in range(20)])
    assert store.topic("wheels", "/wheel").ontology.tag == "WheelSpeed"


def check_arm(store: Store) -> None:
    stored = [(row["shoulder"], row["elbow"]) for row in rows(store, "arm", "/joint_states")]
    assert stored == [*((float(at), at + 0.5) for at in range(19)), (None, None)]


def check_battery(store: Store) -> None:
    stored = [row["voltage"] for row in rows(store, "battery", "/diagnostics")]
    assert stored == pytest.approx([24 + at / 10 for at in range(0, 20, 2)])


def check_transform_rows(store: Store) -> None:
    stored = [(row["parent"], row["child"], row["x"]) for row in rows(store, "transforms", "/tf")]
    assert stored == [("odom", "base", 1.0), ("map", "odom", 1.0)] * 20


def check_devices(store: Store) -> None:
    assert topics(store, "devices") == {"/diagnostics/devices": 30, "/diagnostics/errors": 1}
    [error] = rows(store, "devices", "/diagnostics/errors")
    assert (error["count"], error["first"]) == (1, "battery")


def check_gears(store: Store) -> None:
    assert [row["rpm"] for row in rows(store, "gears", "/wheel")] == list(range(0, 200, 10))
    assert [row["rpm"] for row in rows(store, "gears", "/wheel/rear")] == list(range(0, 100, 5))


def check_calibrated(store: Store) -> None:
    info = store.sequence("calibrated")
    assert info is not None
    assert [attachment.name for attachment in info.attachments] == ["camera.yaml"]
    assert "_records_" not in info.metadata


def check_small(store: Store) -> None:
    stored = rows(store, "small", "/camera/image_raw")
    assert [(row["format"], row["width"], row["height"]) for row in stored] == [("jpeg", 32, 16)] * 40
    pixel = Image.open(io.BytesIO(stored[20]["data"])).getpixel((3, 3))
    assert np.abs(np.subtract(pixel, (100, 120, 200))).max() <= 3  # type: ignore[arg-type] - the pixel has three numbers


def check_described(store: Store) -> None:
    info = store.sequence("described_robot7_20260301")
    assert info is not None
    expected = {"project": "orchard", "serial": "A-7", "robot": 7, "date": "2026-03-01"}
    assert {key: info.metadata.get(key) for key in expected} == expected


def check_most(store: Store) -> None:
    assert [row["data"] for row in rows(store, "most", "/count")] == [0, 1, 3, 4]


def check_refused(store: Store) -> None:
    assert names(store) == []


CHECKS: dict[str, tuple[Check, int]] = {
    "How do I keep only a part of a recording?": (check_part, 0),
    "How do I split a long recording?": (check_split, 0),
    "How do I get one sequence for each event?": (check_events, 0),
    "Why are my signals shifted against each other?": (check_stamps, 0),
    "The clock of one sensor was wrong. How do I shift it?": (check_shifted, 0),
    "How do I select topics, or leave some out?": (check_selected, 0),
    "How do I rename topics?": (check_renamed, 0),
    "How do I reduce the rate of a topic?": (check_reduced, 0),
    "How do I remove one transform from /tf?": (check_transforms, 0),
    "How do I store a state only when it changes?": (check_modes, 0),
    "The recorder split the recording into files. How do I get one sequence?": (check_splits, 0),
    "How do I merge files that different computers recorded?": (check_merged, 0),
    "How do I read an old .db3 file without message definitions?": (check_old, 0),
    "The power failed during recording. How do I save the rest of the file?": (check_saved, 4),
    "How do I ingest a folder of recordings, again and again?": (check_fleet, 0),
    "How do I get my own message type as columns with units?": (check_wheels, 0),
    "How do I get one column per joint?": (check_arm, 0),
    "How do I get the value of one diagnostics entry as a column?": (check_battery, 0),
    "How do I get one row per transform of /tf?": (check_transform_rows, 0),
    "How do I store one message in several topics?": (check_devices, 0),
    "How do I use one adapter with different parameters?": (check_gears, 0),
    "How do I store camera images in less space?": (check_small, 0),
    "Where do the metadata of my recordings go?": (check_described, 0),
    "How do I keep the calibration file that is attached to a recording?": (check_calibrated, 0),
    "One bad message stops everything. How do I go on, and keep it?": (check_most, 4),
    "How do I refuse recordings in which a sensor dropped out?": (check_refused, 6),
}
"""The check of the stored values and the exit code, by question."""


def test_page_answers_twenty_questions() -> None:
    assert list(recipes()) == list(CHECKS)
    assert len(CHECKS) >= 20


@pytest.mark.parametrize("question", CHECKS)
def test_recipe_lints_plans_and_stores_documented_values(files: Path, question: str) -> None:
    check, code = CHECKS[question]
    manifest = files / "recipe.yaml"
    manifest.write_text(recipes()[question][0])
    assert lint_paths([manifest], env={}).findings == ()
    jobs = [
        job.replace(target=job.target.replace(store=str(files / "store")))
        for job in api.compile_job(manifest)
    ]
    plans = [make_plan(Task(job)) for job in jobs]
    assert [f for plan in plans for f in plan.findings if f.severity is Severity.ERROR] == []
    try:
        assert api.run(jobs).exit_code == code
        if question.endswith("again and again?"):
            again = api.run(jobs)
            assert [each.status for each in again.recordings] == ["skipped"] * 2
        check(Store.open(files / "store"))
    finally:
        shutil.rmtree(files / "store", ignore_errors=True)
