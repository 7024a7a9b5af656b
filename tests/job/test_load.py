"""Loading of manifests: values, variables, and findings with locations."""

from __future__ import annotations

from pathlib import Path

import pytest

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import nearest
from mosaico_ingest.job.manifest import check_manifest, load_manifest
from mosaico_ingest.job.values import Stores, TopicLevelErrorPolicy
from mosaico_ingest.job.yaml_source import load_source


def check(text: str, env: dict[str, str] | None = None) -> list[tuple[str, str, str]]:
    manifest, findings = check_manifest(load_source(text, file="j"), env=env)
    assert (manifest is None) == bool(findings)
    return [(str(finding.span)[2:], finding.rule, finding.message) for finding in findings]


def test_load_manifest_full_manifest_returns_model(tmp_path: Path) -> None:
    file = tmp_path / "job.yaml"
    file.write_text(FULL)
    loaded = load_manifest(file, env={"MOSAICO_API_KEY": "k"})
    manifest = loaded.manifest
    assert manifest.bag.ros_distro is Stores.ROS2_HUMBLE
    assert manifest.bag.path == ("part_0.db3", "part_1.db3")
    assert manifest.topics == ("/cam*", "!/cam/debug*")
    assert manifest.on_error.topic == {
        "default": TopicLevelErrorPolicy.Raise,
        "/gps/*": TopicLevelErrorPolicy.Ignore,
    }
    assert loaded.where("bag", "ros_distro") == f"{file}:4:15"
    assert loaded.resolve("x/y") == tmp_path / "x/y"
    assert loaded.resolve("/x") == Path("/x")


FULL = """\
version: 1
bag:
  path: [part_0.db3, part_1.db3]
  ros_distro: ros2_humble
  custom_msgs:
    - package: my_custom_pkg
      path: definitions/my_pkg
      store: ros2_humble
  time: {start: +10s, end: 2026-03-01T12:00:00Z}
sequence:
  name: "{stem}"
  metadata: {driver_version: v2.1, weather: sunny, deep: {a: [1, null, true, 1.5]}}
  metadata_file: metadata.json
  if_exists: append
topics: ["/cam*", "!/cam/debug*"]
topic_settings:
  /imu: {rename: /sensors/imu, metadata: {mount: roof}}
  "/camera/*": {every: 3, image: png}
adapters:
  load: [adapters/battery_pack.yaml, "my_pkg.adapters:WheelAdapter"]
  override: {"/lidar/*": LidarAdapter}
  unmodeled: keep
on_error:
  session: report
  topic: {default: raise, "/gps/*": ignore}
  message: log_warn
target:
  host: mosaico.example.org
  port: 6726
  api_key: ${MOSAICO_API_KEY:?a key with write permission}
  tls_cert: certs/ca.pem
  tls: true
run: {jobs: 2, memory: 512MiB, report: report.json, log_level: INFO}
"""


@pytest.mark.parametrize(
    ("text", "location", "rule", "message"),
    [
        ("", "1:1", "empty-manifest", "the manifest is empty"),
        ("- a", "1:1", "not-a-mapping", "a job is a mapping"),
        ("sequence: {name: x}", "1:1", "missing-key", "the document needs the key 'bag'"),
        ("bag: {pth: x}", "1:7", "unknown-key", "unknown key 'pth' in bag"),
        ("bag: x", "1:6", "wrong-type", "bag must be a mapping, not the text 'x'"),
        ("bag: {path: 5}", "1:13", "wrong-type", "bag.path must be text, not the number 5"),
        ("bag: {path: []}", "1:13", "empty-value", "bag.path is empty"),
        ("bag: {path: [a, 1]}", "1:17", "wrong-type", "bag.path[1] must be text, not the number 1"),
        ("bag: {path: }", "1:7", "empty-value", "bag.path is empty"),
        ("bag: {path: x}\nadapters:", "2:1", "empty-value", "adapters is empty"),
        ("bag: {path: x, ros_distro: humble}", "1:28", "wrong-value", "bag.ros_distro cannot be 'humble'"),
        ("bag: {path: x}\nversion: 2", "2:10", "newer-version", None),
        (
            "bag: {path: x}\nversion: '1'",
            "2:10",
            "wrong-type",
            "version must be a whole number, not the text '1'",
        ),
        ("bag: {path: x}\ntopics: /imu", "2:9", "wrong-type", "topics must be a list, not the text '/imu'"),
        ("bag: {path: x}\non_error: {topic: rase}", "2:19", "wrong-value", "on_error.topic cannot be 'rase'"),
        ("bag: {path: x}\non_error: {topic: {/a: rase}}", "2:24", "wrong-value", None),
        ("bag: {path: x}\ntarget: {store: a, host: b}", "2:20", "conflicting-keys", None),
        ("bag: {path: x}\ntarget: {port: 1}", "2:10", "conflicting-keys", None),
        ("bag: {path: x}\ntarget: {host: h, port: 0}", "2:25", "wrong-value", "target.port is 0"),
        ("bag: {path: x}\nrun: {memory: 1 cow}", "2:15", "wrong-value", None),
        (
            "bag: {path: x}\nrun: {memory: 12}",
            "2:15",
            "wrong-type",
            "run.memory must be text, not the number 12",
        ),
        ("bag: {path: x, time: {end: 10s}}", "1:28", "wrong-value", None),
        ("bag: {path: x}\nros_distro: ros2_humble", "2:1", "unknown-key", None),
        ("bag: {path: x}\nsequence: {name: {stem}}", "2:18", "wrong-type", None),
        ("bag: {path: x}\nsequence: {metadata: {1: a}}", "2:23", "yaml-key", "the key 1 is not text"),
        ('bag: {path: "${}"}', "1:14", "variable-syntax", "${} is not a variable"),
        ('bag: {path: "a${b"}', "1:15", "variable-syntax", "${ is not a variable"),
    ],
)
def test_check_manifest_one_mistake_is_one_located_finding(
    text: str, location: str, rule: str, message: str | None
) -> None:
    first, *rest = check(text)
    assert (first[0], first[1]) == (location, rule)
    assert message is None or first[2] == message
    assert rest == []


def test_check_manifest_several_mistakes_are_in_text_order() -> None:
    text = "bag:\n  path: x\n  ros_distro: humble\ntopics: [!/cam]\nrun: {jobs: 0}\nruns: {}\n"
    assert [(location, rule) for location, rule, _ in check(text)] == [
        ("3:15", "wrong-value"),
        ("4:10", "yaml-tag"),
        ("5:13", "wrong-value"),
        ("6:1", "unknown-key"),
    ]


@pytest.mark.parametrize(
    ("word", "known", "expected"),
    [
        ("time", ["image", "time_offset"], "time_offset"),
        ("distro", ["desert", "ros_distro"], "ros_distro"),
        ("on-error", ["on_error", "on_errors"], "on_error"),
        ("metadta", ["metadata", "rename"], "metadata"),
        ("topic", ["topic_settings", "topics"], "topics"),
        ("tpi", ["topics"], "topics"),
        ("x", ["time_offset", "image"], None),
    ],
)
def test_nearest_prefers_typos_of_one_letter_then_longer_words(
    word: str, known: list[str], expected: str | None
) -> None:
    assert nearest(word, known) == expected


def test_check_manifest_misspelled_required_key_is_not_also_missing() -> None:
    assert [rule for _, rule, _ in check("bagg: {path: x}")] == ["unknown-key"]


def test_load_manifest_variables_are_replaced(tmp_path: Path) -> None:
    file = tmp_path / "job.yaml"
    file.write_text(
        "bag: {path: '${DIR}/a$$b.bag'}\ntarget:\n  host: ${HOST:-localhost}\n  port: ${PORT}\n  tls: ${TLS}\n"
    )
    manifest = load_manifest(file, env={"DIR": "d", "PORT": "12", "TLS": "true"}).manifest
    assert manifest.bag.path == "d/a$b.bag"
    assert (manifest.target.host, manifest.target.port, manifest.target.tls) == ("localhost", 12, True)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("${RUN:int}", 7),
        ("${NONE:int:-3}", 3),
        ("${HEIGHT:float}", 1.0),
        ("${DRY:bool}", True),
        ("${RUN}", "007"),
        ("run ${RUN:int}", "run 007"),
        ("${cell:int}", 5),
    ],
)
def test_load_manifest_variable_with_kind_is_a_value_of_this_type(
    tmp_path: Path, written: str, value: object
) -> None:
    file = tmp_path / "job.yaml"
    file.write_text(
        f'bag: {{path: a}}\nsequence:\n  metadata: {{key: ["{written}"]}}\nmatrix: {{cell: [5]}}\n'
    )
    manifest = load_manifest(file, env={"RUN": "007", "HEIGHT": "1", "DRY": "True"}).manifest
    ((loaded,),) = manifest.sequence.metadata.values()
    assert (loaded, type(loaded)) == (value, type(value))


def test_check_manifest_variable_of_another_kind_is_one_located_finding() -> None:
    text = "bag: {path: x}\nsequence: {metadata: {run: '${RUN:int}', dry: '${DRY:bool}'}}\n"
    assert check(text, env={"RUN": "seven", "DRY": "1"}) == [
        ("2:28", "wrong-type", "RUN must be a whole number, not the text 'seven'"),
        ("2:47", "wrong-type", "DRY must be true or false, not the text '1'"),
    ]
    assert [rule for _, rule, _ in check(text, env={})] == ["unset-variable", "unset-variable"]


def test_check_manifest_unset_variable_is_finding_with_its_message() -> None:
    text = "bag: {path: x}\ntarget:\n  host: h\n  api_key: ${KEY:?a key with write permission}\n"
    assert check(text, env={}) == [("4:12", "unset-variable", "KEY is not set: a key with write permission")]


def test_check_manifest_without_environment_ignores_unset_variables() -> None:
    assert check("bag: {path: '${A}'}\ntarget:\n  host: ${B}\n  port: ${C}\n  tls: ${D:?why}\n") == []


def test_load_manifest_section_variable_without_environment_raises_without_findings(tmp_path: Path) -> None:
    assert check("bag: ${A}\n", env={}) == [("1:6", "unset-variable", "A is not set")]
    source = load_source("bag: ${A}\n", file="j")
    assert check_manifest(source, env=None) == (None, ())
    file = tmp_path / "job.yaml"
    file.write_text(source.text)
    with pytest.raises(ManifestError, match="incomplete without"):
        load_manifest(file, env=None)


def test_check_manifest_invalid_variable_value_is_not_shown() -> None:
    text = (
        "bag: {path: x, ros_distro: '${A}'}\nsequence:\n  if_exists: ${A}\ntarget:\n  host: h\n  port: ${A}\n"
    )
    _, findings = check_manifest(load_source(text, file="j"), env={"A": "s3cret"})
    assert len(findings) == 3
    assert all("s3cret" not in str(finding) for finding in findings)


def test_check_manifest_api_key_of_wrong_type_is_not_shown() -> None:
    _, findings = check_manifest(
        load_source("bag: {path: x}\ntarget: {host: h, api_key: 123456}\n", file="j"), env={}
    )
    assert [str(finding) for finding in findings] == [
        "j:2:28: error[wrong-type] target.api_key must be text — quote it"
    ]


def test_manifest_repr_hides_api_key() -> None:
    text = "bag: {path: x}\ntarget: {host: h, api_key: s3cret}\n"
    manifest, _ = check_manifest(load_source(text, file="j"), env={})
    assert manifest is not None
    assert "s3cret" not in repr(manifest)


@pytest.mark.parametrize(
    ("content", "rule"), [(None, "unreadable-file"), (b"\xff\xfe", "not-utf8"), (b"", "empty-manifest")]
)
def test_load_manifest_unreadable_file_is_one_finding(
    tmp_path: Path, content: bytes | None, rule: str
) -> None:
    file = tmp_path / "job.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ManifestError) as caught:
        load_manifest(file)
    assert [finding.rule for finding in caught.value.findings] == [rule]
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_load_manifest_directory_raises(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="directory"):
        load_manifest(tmp_path)


@pytest.mark.parametrize("name", ["drive.mcap", "drive.db3", "drive.bag"])
def test_load_manifest_recording_raises_with_hint(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ManifestError, match="is a recording, not a manifest") as caught:
        load_manifest(file)
    assert "ingest bag" in str(caught.value.findings[0].help)
