"""A manifest compiles to a job for each recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from mosaico_ingest.errors import IngestError, ManifestError, NothingMatched
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.job.model import Job, JobSettings, QuarantineSettings, TimeRange
from mosaico_ingest.job.values import (
    IfExists,
    Limit,
    LoaderErrorPolicy,
    LockFile,
    OnSchemaChange,
    ServerTarget,
    SessionLevelErrorPolicy,
    Stores,
    StoreTarget,
    TimeBound,
    TopicLevelErrorPolicy,
    Unmodeled,
)
from mosaico_ingest.pipeline.compile import compile_manifest
from mosaico_ingest.pipeline.run import run_recording
from mosaico_ingest.pipeline.task import Task

DEFAULT = ROSInjectionConfig("a", "b").job


def compiled(folder: Path, text: str) -> Sequence[Job]:
    file = folder / "job.yaml"
    file.write_text(text)
    return compile_manifest(load_manifest(file, env={"KEY": "k"}))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    data = tmp_path / "data"
    (data / "run_c").mkdir(parents=True)
    (data / "run_c" / "metadata.yaml").touch()
    for name in ("run_a.bag", "run 1.2.mcap", "notes.txt"):
        (data / name).touch()
        os.utime(data / name, (86_400, 86_400))
    (tmp_path / "msgs").mkdir()
    (tmp_path / "ca.pem").touch()
    (tmp_path / "metadata.json").write_text('{"weather": "rain", "driver": "Ada"}')
    return tmp_path


def test_compile_manifest_with_every_key_sets_every_field(folder: Path) -> None:
    (folder / "job.lock.json").write_text("{}")
    (job,) = compiled(
        folder,
        """
bag:
  path: [data/run_a.bag, "data/run 1.2.mcap"]
  ros_distro: ros2_humble
  custom_msgs: [{package: p, path: msgs, store: ros1_noetic}]
  time: {start: +10s, end: 2026-03-01T12:00:00Z}
sequence: {name: "x_{stem}", family: f, metadata: {weather: sunny}, metadata_file: metadata.json, if_exists: append}
topics: [/cam*]
topic_settings: {/imu: {rename: /sensors/imu, metadata: {mount: roof}}, "/camera/*": {every: 3, image: png}}
adapters:
  load: [a.yaml]
  override: {/lidar: LidarAdapter}
  unmodeled: skip
  serialization_formats: {p/msg/Scan: ragged}
on_error: {session: delete, topic: {default: finalize, /gps: ignore}, message: raise}
on_schema_change: new_topic
expect: {required: [/imu]}
definitions: locked
quarantine: {path: q, max: 0.1%, max_run: 100, systematic: 7}
target: {host: h, port: 1, api_key: "${KEY}", tls_cert: ca.pem, tls: true, message_size: 4MB}
run: {log_level: DEBUG, report: r.json, memory: 1MiB, jobs: 2}
split: {by: 10 min}
network: {attempts: 7, timeout: 1 min, max_download: 1GiB}
""",
    )
    expected = ROSInjectionConfig(
        file_path=(folder / "data/run_a.bag", folder / "data/run 1.2.mcap"),
        sequence_name="x_run_a",
        metadata={"weather": "sunny", "driver": "Ada"},
        host="h",
        port=1,
        mosaico_api_key="k",
        tls_cert_path=folder / "ca.pem",
        enable_tls=True,
        ros_distro=Stores.ROS2_HUMBLE,
        custom_msgs=(("p", folder / "msgs", Stores.ROS1_NOETIC),),
        topics=("/cam*",),
        topic_metadata={"/imu": {"mount": "roof"}},
        adapter_override={"/lidar": "LidarAdapter"},
        serialization_formats={"p/msg/Scan": "ragged"},
        on_error=SessionLevelErrorPolicy.Delete,
        topics_on_error={"default": TopicLevelErrorPolicy.Finalize, "/gps": TopicLevelErrorPolicy.Ignore},
        log_level="DEBUG",
        manifest={
            "bag": {
                "time": TimeRange(start=TimeBound(10**10, relative=True), end=TimeBound(1772366400 * 10**9))
            },
            "sequence": {"family": "f", "if_exists": IfExists.APPEND},
            "split": {"by": 600 * 10**9},
            "network": {"attempts": 7, "timeout": 60 * 10**9, "max_download": 2**30},
            "topic_settings": {
                "/imu": {"rename": "/sensors/imu"},
                "/camera/*": {"every": 3, "image": "png"},
            },
            "adapters": {"load": ["a.yaml"], "unmodeled": Unmodeled.SKIP},
            "on_error": {"message": LoaderErrorPolicy.RAISE},
            "on_schema_change": OnSchemaChange.NEW_TOPIC,
            "expect": {"required": ["/imu"]},
            "quarantine": QuarantineSettings(
                path=str(folder / "q"), max=Limit(share=0.001), max_run=Limit(100), systematic=7
            ),
            "target": {"message_size": 4_000_000},
            "run": {"report": folder / "r.json", "memory": 2**20, "jobs": 2},
        },
    ).job
    bag = expected.bag.replace(path=("data/run_a.bag", "data/run 1.2.mcap"))
    lock = LockFile(str(folder / "job.lock.json"), "{}")
    assert job == expected.replace(bag=bag, origin=job.origin, definitions="locked", lock=lock)
    assert job.bag.custom_msgs[0].path == str(folder / "msgs")
    assert job.origin.file == str(folder / "job.yaml")
    assert job.where("run", "jobs") == f"{folder / 'job.yaml'}:21:61"
    assert [key for key in JobSettings.model_fields if getattr(job, key) == getattr(DEFAULT, key)] == []


def test_compile_smallest_manifest_has_defaults(folder: Path) -> None:
    (job,) = compiled(folder, "bag: {path: data/run_a.bag}")
    assert (job.sequence.name, job.family) == ("run_a", "{stem}")
    assert job.destination == StoreTarget(Path("mosaico"))
    changed = [key for key in JobSettings.model_fields if getattr(job, key) != getattr(DEFAULT, key)]
    assert changed == ["bag", "sequence"]


def test_compile_store_path_starts_at_manifest_folder(folder: Path) -> None:
    (job,) = compiled(folder, "bag: {path: data/run_a.bag}\ntarget: {store: ./s}")
    assert job.destination == StoreTarget(folder / "s")
    (job,) = compiled(folder, "bag: {path: data/run_a.bag}\ntarget: {host: h}")
    assert job.destination == ServerTarget("h", 6726)


def test_compile_glob_makes_one_job_per_recording(folder: Path) -> None:
    jobs = compiled(folder, 'bag: {path: "data/*"}\nsequence: {name: "{parent}_{stem}_{index:02}"}')
    assert [(job.paths[0].name, job.sequence.name) for job in jobs] == [
        ("run 1.2.mcap", "data_run_1_2_01"),
        ("run_a.bag", "data_run_a_02"),
        ("run_c", "data_run_c_03"),
    ]


def test_compile_recursive_glob_finds_recordings(folder: Path) -> None:
    assert [job.sequence.name for job in compiled(folder, 'bag: {path: "**/*.bag"}')] == ["run_a"]


def test_compile_glob_skips_hidden_files_unless_it_names_them(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "data" / "._run_a.bag").write_bytes(b"a copy's attributes")
    (folder / ".trash").mkdir()
    (folder / ".trash" / "run_d.bag").touch()
    for pattern, names in (
        ("data/*.bag", ["run_a"]),
        ("**/*.bag", ["run_a"]),
        ("data/.*.bag", ["run_a"]),
        (".trash/*.bag", ["run_d"]),
    ):
        jobs = compiled(folder, f'bag: {{path: "{pattern}"}}')
        assert [job.sequence.name for job in jobs] == names, pattern
    monkeypatch.chdir(folder / "data")
    (job,) = compiled(Path(), 'bag: {path: "*.bag"}')
    assert job.sequence.name == "run_a"


def test_compile_two_stars_beside_other_characters_match_like_one(folder: Path) -> None:
    assert [job.sequence.name for job in compiled(folder, 'bag: {path: "data/**.bag"}')] == ["run_a"]


def test_sequence_name_placeholders_are_parts_of_the_path(folder: Path) -> None:
    (job,) = compiled(folder, 'bag: {path: data/run_a.bag}\nsequence: {name: "{name}_{date}_{index}"}')
    assert job.sequence.name == "run_a_bag_1970-01-02_1"
    (job,) = compiled(folder, "bag: {path: data/run_c/metadata.yaml}")
    assert job.sequence.name == "run_c"


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("bag: {path: data/run_b.bag}", NothingMatched, r"job.yaml:1:13: no such file .*run_a.bag"),
        ("bag: {path: [data/run_a.bag, data/x]}", NothingMatched, r"job.yaml:1:30: no such file"),
        ("bag: {path: nowhere/x.bag}", NothingMatched, r"no such file"),
        ('bag: {path: "data/*.db3"}', NothingMatched, r"no recording matches .* has run 1.2.mcap, run_a.bag"),
        ('bag: {path: "data/*.txt"}', NothingMatched, r"no recording matches .*it matches 1 other files"),
        ('bag: {path: "data/*"}\nsequence: {name: x}', ManifestError, r"job.yaml:2:18: 3 recordings .* 'x'"),
        (
            "bag: {path: data/run_a.bag}\nsequence: {name: '{day}'}",
            ManifestError,
            r"unknown placeholder \{day\}",
        ),
        (
            "bag: {path: data/run_a.bag}\nsequence: {name: 'a b'}",
            IngestError,
            r"job.yaml:2:18: sequence name 'a b'",
        ),
        (
            "bag: {path: data/run_a.bag}\nsequence: {metadata_file: x.json}",
            ManifestError,
            r"2:27: .*cannot be read",
        ),
        ("bag: {path: data/run_a.bag}\nsequence: {metadata_file: job.yaml}", ManifestError, r"is not JSON"),
        (
            "bag: {path: data/run_a.bag, custom_msgs: [{package: p, path: nope}]}",
            ManifestError,
            r"job.yaml:1:62: no such file or directory: .*nope",
        ),
    ],
)
def test_compile_missing_file_or_invalid_name_is_refused_with_location(
    folder: Path, text: str, kind: type[IngestError], message: str
) -> None:
    with pytest.raises(kind, match=message) as caught:
        compiled(folder, text)
    assert "\n" not in str(caught.value)


def test_compile_metadata_file_without_object_is_refused(folder: Path) -> None:
    (folder / "metadata.json").write_text("[1]")
    with pytest.raises(ManifestError, match="no JSON object"):
        compiled(folder, "bag: {path: data/run_a.bag}\nsequence: {metadata_file: metadata.json}")


def test_make_plan_chunk_larger_than_max_chunk_size_is_unreadable(tmp_path: Path) -> None:
    drive = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
    text = f"bag: {{path: {drive}, max_chunk_size: 1MiB}}\ntarget: {{store: {tmp_path}/store}}\n"
    (job,) = compiled(tmp_path, text)
    report = run_recording(Task(job)).report
    assert report.exit_code == 4
    assert any("1048576 bytes" in loss.reason for loss in report.unreadable_ranges)
    unlimited = job.replace(
        bag=job.bag.replace(max_chunk_size=None), sequence=job.sequence.replace(name="unlimited")
    )
    assert run_recording(Task(unlimited)).report.exit_code == 0
