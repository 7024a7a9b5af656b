"""Recordings behind URLs: they equal local files, and only the necessary parts are downloaded."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zstandard
from made_recordings import define, record
from object_store import Counts, ObjectStore, object_store

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import BagError, NothingMatched, Unreachable
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.job.values import SessionLevelErrorPolicy
from mosaico_ingest.pipeline.compile import compile_manifest, find_recordings
from mosaico_ingest.remote import AnyPath, RemotePath, as_path
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording

pytestmark = pytest.mark.slow

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
BLOB = define("made/msg/Blob", "uint8[] data")
FLOAT = define("made/msg/Float", "float64 data")


def remote(objects: ObjectStore, key: str) -> RemotePath:
    path = as_path(objects.url(key))
    assert isinstance(path, RemotePath)
    return path


def put(objects: ObjectStore, file: Path, key: str) -> RemotePath:
    path = remote(objects, key)
    path.write_bytes(file.read_bytes())
    objects.counts()
    return path


def opened(*paths: AnyPath) -> Recording:
    return open_recording(paths, resolve=TypeResolver(None, [], registry=ROSTypeRegistry))


def messages(recording: Recording) -> list[tuple[str, int, bytes]]:
    """Return topic, time and payload of each message, in the order of time within its topic."""
    actual: list[tuple[str, int, bytes]] = []
    for batch in recording.message_blocks():
        ends = (batch.starts + batch.lengths).tolist()
        places = zip(batch.log_times.tolist(), batch.starts.tolist(), ends, strict=True)
        actual += [
            (recording.connections[batch.connection].topic, at, batch.data[start:end].tobytes())
            for at, start, end in places
        ]
    return sorted(actual)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module", params=["mcap", "db3", "bag"])
def small(request: pytest.FixtureRequest, folder: Path) -> Path:
    """Ten seconds of two topics."""
    version = 1 if request.param == "bag" else 2
    number = define("made/msg/Float", "float64 data", version=version)
    sent = [
        (topic, number, START_NS + step * SECOND_NS // 10, {"data": step / 7})
        for step in range(100)
        for topic in ("/a", "/b")
    ]
    return record(folder / f"small.{request.param}", sent)


@pytest.fixture(scope="module")
def large(folder: Path) -> Path:
    """50 MB of what does not compress, a hundred seconds; `/rare` is in the first second only."""
    rng = random.Random(7)  # noqa: S311 - any bytes will do
    blobs = [
        ("/blobs", BLOB, START_NS + step * SECOND_NS // 5, {"data": list(rng.randbytes(100_000))})
        for step in range(500)
    ]
    rare = [("/rare", FLOAT, START_NS + 1 + step, {"data": float(step)}) for step in range(10)]
    return record(folder / "large.mcap", sorted(blobs + rare, key=lambda one: one[2]))


@pytest.fixture
def own_objects(objects: ObjectStore) -> Iterator[ObjectStore]:
    """A server of the test's own, which it may kill; the credentials are those of the other."""
    assert objects.port
    with object_store() as running:
        yield running


def test_recording_by_url_equals_the_file(objects: ObjectStore, small: Path) -> None:
    path = put(objects, small, f"every/{small.name}")
    with opened(small) as here, opened(path) as there:
        assert messages(there) == messages(here)
        assert there.unreadable == here.unreadable == ()
        assert there.message_count == (None if small.suffix == ".db3" else here.message_count)
        assert (there.start_ns, there.end_ns) == (here.start_ns, here.end_ns)
        assert there.size_bytes == small.stat().st_size


def test_recording_without_ranges_is_downloaded_and_removed(
    objects: ObjectStore, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = tmp_path / f"{small.name}.zstd"
    packed.write_bytes(zstandard.compress(small.read_bytes()))
    path = put(objects, packed, f"packed/{packed.name}")
    room = tmp_path / "allocate"
    room.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(room))
    with opened(small) as here, opened(path) as there:
        assert messages(there) == messages(here)
        assert any(one.rule == "container-note" for one in there.findings)
        assert list(room.iterdir())
    assert not list(room.iterdir())


def test_recording_larger_than_the_temporary_folder_is_refused(
    objects: ObjectStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = folder / "no_room.db3.zstd"
    packed.write_bytes(zstandard.compress(b"content"))
    path = put(objects, packed, packed.name)
    monkeypatch.setattr("shutil.disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))
    with pytest.raises(BagError, match=r"no_room.db3.zstd: \d+ bytes .* only 0 are free"):
        opened(path)


def test_recording_without_index_is_downloaded_and_read_record_by_record(
    objects: ObjectStore, small: Path, tmp_path: Path
) -> None:
    if small.suffix == ".db3":
        return
    cut = tmp_path / f"cut{small.suffix}"
    cut.write_bytes(small.read_bytes()[: small.stat().st_size * 2 // 3])
    path = put(objects, cut, f"cut/{cut.name}")
    with opened(cut) as here, opened(path) as there:
        assert messages(there) == messages(here)
        assert [loss.reason for loss in there.unreadable] == [loss.reason for loss in here.unreadable]
        assert any("it has no index" in one.message for one in there.findings)


def test_inspecting_a_recording_reads_a_small_part(objects: ObjectStore, large: Path) -> None:
    path = put(objects, large, "large/large.mcap")
    with opened(path) as there:
        assert there.message_count == 510
    asked = objects.counts()
    assert asked.sent_bytes < 1 << 20
    assert len(asked.requests) <= 8


@pytest.mark.parametrize("selection", ["time", "topic"])
def test_selection_of_a_recording_reads_a_small_part(
    objects: ObjectStore, large: Path, selection: str
) -> None:
    path = put(objects, large, "large/large.mcap")
    window = (START_NS + 50 * SECOND_NS, START_NS + 51 * SECOND_NS)
    with opened(path) as there:
        if selection == "time":
            batches = there.message_blocks(start_ns=window[0], end_ns=window[1])
        else:
            batches = there.message_blocks([one.id for one in there.connections if one.topic == "/rare"])
        assert sum(map(len, batches)) == (5 if selection == "time" else 10)
    asked = objects.counts()
    assert asked.sent_bytes < large.stat().st_size * 0.2
    assert len(asked.requests) <= 12


def test_reading_a_complete_recording_needs_few_requests(objects: ObjectStore, large: Path) -> None:
    path = put(objects, large, "large/large.mcap")
    with opened(path) as there:
        assert sum(map(len, there.message_blocks())) == 510
    asked = objects.counts()
    gets = [line for line in asked.requests if line.startswith("GET")]
    assert len(gets) <= 20
    assert asked.sent_bytes < large.stat().st_size * 1.1


def test_reader_that_stops_early_leaves_no_thread(objects: ObjectStore, large: Path) -> None:
    path = put(objects, large, "large/large.mcap")
    with opened(path) as there:
        next(there.message_blocks())
    asked: Counts = objects.counts()
    assert asked.sent_bytes < large.stat().st_size * 0.8


def test_splits_directories_and_globs_are_found(objects: ObjectStore, tmp_path: Path) -> None:
    for number in range(3):
        sent = [("/a", FLOAT, START_NS + number * SECOND_NS + step, {"data": 1.0}) for step in range(4)]
        file = record(tmp_path / f"part_{number}.mcap", sent)
        put(objects, file, f"drives/night/part_{number}.mcap")
    (tmp_path / "readme.txt").write_text("no recording")
    put(objects, tmp_path / "readme.txt", "drives/night/readme.txt")
    night = remote(objects, "drives/night")
    with opened(night) as whole:
        assert whole.message_count == 12
    with opened(night / "part_0.mcap", night / "part_2.mcap") as two:
        assert [str(file) for file in two.files] == [
            "s3://bucket/drives/night/part_0.mcap",
            "s3://bucket/drives/night/part_2.mcap",
        ]
        assert len(messages(two)) == 8
    for pattern, group, names in [
        ("drives/night/part_*.mcap", "none", ["part_0", "part_1", "part_2"]),
        ("drives/night/part_*.mcap", "auto", ["part"]),
        ("drives/*/part_[12].mcap", "auto", ["part_1", "part_2"]),
        ("drives/**/part_1.mcap", "auto", ["part_1"]),
        ("drives/*", "auto", ["night"]),
    ]:
        job = tmp_path / "job.yaml"
        job.write_text(
            f'bag: {{path: "{objects.url(pattern)}", group: {group}}}\nsequence: {{name: "{{stem}}"}}\n'
        )
        assert [one.sequence.name for one in compile_manifest(load_manifest(job))] == names
    job.write_text(f'bag: {{path: "{objects.url("drives/none*.mcap")}"}}\nsequence: {{name: a}}\n')
    with pytest.raises(NothingMatched, match=r"no recording matches s3://bucket/drives/none\*.mcap"):
        find_recordings(load_manifest(job))


def test_rosbag2_directory_is_read_through_its_metadata(objects: ObjectStore, tmp_path: Path) -> None:
    sent = [("/a", FLOAT, START_NS + step, {"data": 1.0}) for step in range(4)]
    put(objects, record(tmp_path / "x_0.mcap", sent), "rosbag2/x/x_0.mcap")
    put(objects, record(tmp_path / "stray.mcap", sent), "rosbag2/x/stray.mcap")
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 5, storage_identifier: mcap, relative_file_paths: [x_0.mcap, x_1.mcap],"
        " message_count: 4, topics_with_message_count: []}"
    )
    put(objects, tmp_path / "metadata.yaml", "rosbag2/x/metadata.yaml")
    with opened(remote(objects, "rosbag2/x")) as there:
        assert [file.name for file in there.files] == ["x_0.mcap"]
        assert any(one.rule == "missing-split" for one in there.findings)


def test_missing_recording_is_an_error_that_names_it(objects: ObjectStore) -> None:
    with pytest.raises(BagError, match=r"s3://bucket/nowhere\.mcap: does not exist"):
        opened(remote(objects, "nowhere.mcap"))


def test_recording_that_changes_while_it_is_read_is_an_error(objects: ObjectStore, small: Path) -> None:
    path = put(objects, small, f"changing/{small.name}")
    with opened(path) as there:
        path.write_bytes(small.read_bytes()[:-1] + b"!")
        with pytest.raises(Unreachable, match="changed while it was being read"):
            list(there.message_blocks())


def test_unavailable_server_is_an_error_and_not_an_unreadable_range(
    own_objects: ObjectStore, large: Path, tmp_path: Path
) -> None:
    path = put(own_objects, large, "large.mcap")
    store = tmp_path / "mosaico"
    config = ROSInjectionConfig(
        path, sequence_name="large", store=store, on_error=SessionLevelErrorPolicy.Delete
    )
    own_objects.fail_after(6, containing="GET /bucket/large.mcap")
    (report,) = api.run([config]).recordings
    assert report.exit_code == 1
    assert report.error is not None
    assert "does not respond" in report.error
    assert Store.open(store).names() == ()


def test_the_ledger_knows_a_recording_by_what_its_store_says(
    objects: ObjectStore, small: Path, tmp_path: Path
) -> None:
    path = put(objects, small, f"ledger/{small.name}")
    job = tmp_path / "job.yaml"
    job.write_text(
        f'bag: {{path: "{path.url}", ros_distro: ros2_humble}}\n'
        "sequence: {name: drive, if_exists: skip}\non_error: {topic: ignore}\ntarget: {store: mosaico}\n"
    )

    def standing() -> str:
        (status,) = api.job_status(job)
        return status.status.value

    assert standing() == "new"
    (report,) = api.run(api.compile_job(job)).recordings
    assert report.exit_code == 0, report.error
    objects.counts()
    assert standing() == "done"
    assert sum(line.startswith("GET /bucket/ledger") for line in objects.counts().requests) <= 4
    path.write_bytes(small.read_bytes() + b"\n")
    assert standing() in {"changed", "unreadable"}


def test_watch_of_url_ingests_new_objects_and_skips_them_again(objects: ObjectStore, tmp_path: Path) -> None:
    put(objects, record(tmp_path / "a.mcap", [("/a", FLOAT, START_NS, {"data": 1.0})]), "watched/day/a.mcap")
    job = tmp_path / "job.yaml"
    job.write_text("bag: {path: unused.mcap}\nsequence: {name: '{stem}'}\ntarget: {store: store}\n")
    arguments = ["watch", objects.url("watched"), str(job), "--once", "--rest", "0.1", "--every", "0.1"]
    outputs = [
        subprocess.run(  # noqa: S603 - our own command
            [sys.executable, "-m", "mosaico_ingest", *arguments],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        ).stdout
        for _ in range(2)
    ]
    assert "watched/day/a.mcap: completed as a, 1 message" in outputs[0]
    assert "watched/day/a.mcap: skipped as a" in outputs[1]
    assert "endpoint_override" not in "".join(outputs)
    assert Store.open(tmp_path / "store").names() == ("a",)
