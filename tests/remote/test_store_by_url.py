"""Stores behind URLs: they equal stores on a disk, and killed writers leave nothing visible."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest
from made_recordings import define, record
from object_store import ObjectStore, object_store

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.compaction import compact
from mosaico_ingest.destinations.store.session import StoreTopic
from mosaico_ingest.destinations.store.store import verify
from mosaico_ingest.errors import (
    SequenceExists,
    SinkError,
    SinkUnavailable,
    Unreachable,
)
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import RemotePath, as_path
from mosaico_ingest.serve import serve

pytestmark = pytest.mark.slow

START_NS = 1_700_000_000_000_000_000
WRITER = Path(__file__).parents[1] / "store/writer_process.py"
TEXT = define("std_msgs/msg/String", "string data")
LIMIT_S = 120
POINT = OntologyType("Point", pa.struct([pa.field("x", pa.float64())]))
POINTS = pa.RecordBatch.from_pylist([{"timestamp_ns": 1, "x": 1.0}], schema=topic_schema(POINT))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    sent = [
        (topic, TEXT, START_NS + step, {"data": f"{topic} {step}"})
        for step in range(500)
        for topic in ("/a", "/b/c")
    ]
    return record(tmp_path / "drive.mcap", sent)


@pytest.fixture
def url(objects: ObjectStore, tmp_path: Path) -> str:
    return objects.url(f"stores/{tmp_path.name}")


@pytest.fixture
def own_objects(objects: ObjectStore) -> Iterator[ObjectStore]:
    """A server of the test's own, which it may kill; the credentials are those of the other."""
    assert objects.port
    with object_store() as running:
        yield running


def root_of(url: str) -> RemotePath:
    path = as_path(url)
    assert isinstance(path, RemotePath)
    return path


def keys(url: str) -> list[str]:
    """Return what lies in the store, without names of sessions."""
    root = root_of(url)
    return [str(one)[len(str(root)) + 1 :] for one in root.listing(recursive=True) if one.is_file()]


def ingest(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mosaico_ingest", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=LIMIT_S, check=False)  # noqa: S603 - this interpreter


def job(folder: Path, recording: str, store: str, if_exists: str = "fail") -> str:
    name = f"{if_exists}.yaml"
    (folder / name).write_text(
        f'bag: {{path: "{recording}"}}\nsequence: {{name: "{{stem}}", if_exists: {if_exists}}}\n'
        f'target: {{store: "{store}"}}\n'
    )
    return name


def test_store_by_url_has_the_same_rows_as_a_store_on_disk(recording: Path, url: str, tmp_path: Path) -> None:
    for store in ("here", url):
        result = ingest("run", job(tmp_path, str(recording), store), cwd=tmp_path)
        assert result.returncode == 0, result.stderr
    here, there = Store.open(tmp_path / "here", create=False), Store.open(url, create=False)
    assert there.names() == here.names() == ("drive",)
    one, other = here.sequence("drive"), there.sequence("drive")
    assert other.metadata == one.metadata
    for mine, theirs in zip(one.topics, other.topics, strict=True):
        assert (theirs.name, theirs.ontology, theirs.metadata) == (mine.name, mine.ontology, mine.metadata)
        assert (theirs.rows, theirs.stored_bytes, theirs.checksum) == (
            mine.rows,
            mine.stored_bytes,
            mine.checksum,
        )
        assert there.scan("drive", theirs.name).read_all() == here.scan("drive", mine.name).read_all()
    assert [checked.problem for checked in verify(other)] == [None, None]
    folders = ["catalog", "changes", "segments", "segments", "store.json"]
    assert [key.partition("/")[0] for key in keys(url)] == folders


def test_every_store_command_accepts_a_url(recording: Path, url: str, tmp_path: Path) -> None:
    source = root_of(url) / "in/drive.mcap"
    source.write_bytes(recording.read_bytes())
    store = f"{root_of(url)}/store?{root_of(url).options}"

    def run(*arguments: str, exits: int = 0) -> str:
        result = ingest(*arguments, cwd=tmp_path)
        assert result.returncode == exits, (arguments, result.stdout, result.stderr)
        return result.stdout + result.stderr

    first = job(tmp_path, source.url, store)
    assert "/b/c" in run("inspect", source.url)
    assert "0 findings" in run("lint", first)
    assert "store s3://bucket" in run("plan", first)
    assert "new" in run("status", first)
    run("run", first)
    assert "the sequence already exists" in run("run", first, exits=1)
    assert "done" in run("status", first)
    again = job(tmp_path, source.url, store, "skip")
    assert "skipped" in run("run", again)
    run("run", job(tmp_path, source.url, store, "append"))
    assert json.loads(run("store", "ls", "--store", store, "--json"))[0]["rows"] == 2000
    run("run", job(tmp_path, source.url, store, "replace"))
    assert json.loads(run("store", "ls", "--store", store, "--json"))[0]["rows"] == 1000
    assert "all complete and intact" in run("verify", "--store", store)
    assert "s3://bucket" in run("store", "show", "drive/b/c", "--store", store)
    run("export", "drive", "--store", store, "--to", "again.mcap")
    assert (tmp_path / "again.mcap").is_file()
    assert "0 files, 0 B" in run("store", "gc", "--store", store)
    run("store", "rm", "drive", "--yes", "--store", store)
    assert json.loads(run("store", "ls", "--store", store, "--json")) == []
    assert "in a local folder" in run("serve", "--store", store, exits=1)
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == []


def test_quarantine_and_replay_work_with_a_store_by_url(url: str, tmp_path: Path) -> None:
    number = define("std_msgs/msg/Float64", "float64 data")
    sent = [("/x", number, START_NS + step, {"data": float(step)}) for step in range(10)]
    recording = record(tmp_path / "drive.mcap", sent)
    (tmp_path / "job.yaml").write_text(
        f'bag: {{path: "{recording}"}}\nsequence: {{name: drive}}\nquarantine: {{}}\n'
        f'adapters: {{load: [read.yaml]}}\ntarget: {{store: "{url}"}}\n'
    )
    adapter = "version: 1\nadapter: Read\nros_type: std_msgs/msg/Float64\nontology: Floating64\nfields: {data: %s}\n"
    (tmp_path / "read.yaml").write_text(adapter % '"null_if(data, 3.0)"')
    result = ingest("run", "job.yaml", cwd=tmp_path)
    assert result.returncode == 4, result.stderr
    assert Store.open(url).sequence("drive").rows == 9
    (tmp_path / "read.yaml").write_text(adapter % "data")
    result = ingest("replay", "quarantine", "-m", "job.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert Store.open(url).scan("drive", "/x").read_all()["data"].to_pylist() == list(range(10))


@pytest.mark.parametrize("if_exists", ["fail", "replace"])
def test_killed_writer_leaves_nothing_visible(
    url: str, if_exists: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.open(url)
    if if_exists == "replace":
        assert _ended(_write(url, "fail", 0)) == 0
    before = store.sequences()
    with _write(url, if_exists, 1) as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(2)] == ["ready\n", "open\n"]
        deadline = time.monotonic() + LIMIT_S
        while len(list(store.layout.segment_files())) <= 4 * len(before) and process.poll() is None:
            assert time.monotonic() < deadline
        process.kill()
        process.wait(LIMIT_S)
    left = list(store.layout.segment_files())
    if store.sequences() != before:
        return  # it was faster than the signal
    with pytest.raises(SequenceExists, match="another run"):
        store.catalog.claim("someone", "drive", IfExists.REPLACE, is_live=store.layout.is_live)
    assert store.collect_garbage().sessions == 0, "it may still live"
    monkeypatch.setattr("mosaico_ingest.destinations.store.files._SILENT_S", -2.0)
    collected = store.collect_garbage()
    assert collected.sessions == 1
    assert collected.files == len(left) - 4 * len(before)
    assert store.sequences() == before
    assert not [key for key in keys(url) if key.startswith(("sessions/", "claims/"))]
    assert _ended(_write(url, "replace", 2)) == 0


def _write(url: str, if_exists: str, source: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(WRITER), url, "drive", if_exists, str(source)]
    return subprocess.Popen(  # noqa: S603 - this interpreter, our own script
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def _ended(process: subprocess.Popen[str]) -> int:
    """Wait for a writer that speaks little."""
    with process:
        try:
            return process.wait(LIMIT_S)
        finally:
            process.kill()


def test_store_that_becomes_unavailable_ends_the_run(
    own_objects: ObjectStore, recording: Path, tmp_path: Path
) -> None:
    store = own_objects.url("store")
    own_objects.fail_after(0, containing="PUT /bucket/store/segments")
    result = ingest("run", job(tmp_path, str(recording), store), cwd=tmp_path)
    assert result.returncode == 1
    assert "does not respond" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "s3:").exists()


@pytest.mark.parametrize(
    ("refusal", "left"),
    [(FileNotFoundError("collected"), ["sessions"]), (Unreachable("gone"), ["segments", "sessions"])],
    ids=["its session was collected", "the store is gone"],
)
def test_files_of_ended_session_are_removed_then_or_by_gc(
    url: str, refusal: Exception, left: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unlink(path: RemotePath) -> None:
        if "/sessions/" in str(path):
            raise refusal
        removed(path)

    store, removed = Store.open(url), RemotePath.unlink
    with pytest.raises(KeyboardInterrupt), StoreSink(store).open("s", {}) as session:
        topic = session.topic("/t", POINT, {})
        topic.write(POINTS)
        assert isinstance(topic, StoreTopic)
        topic.close()  # an object is there once it is closed
        monkeypatch.setattr(RemotePath, "unlink", unlink)
        raise KeyboardInterrupt
    monkeypatch.undo()
    folders = {key.partition("/")[0] for key in keys(url)}
    assert sorted(folders & {"segments", "sessions"}) == left
    monkeypatch.setattr("mosaico_ingest.destinations.store.files._SILENT_S", -2.0)
    store.collect_garbage()
    assert sorted({key.partition("/")[0] for key in keys(url)} - {"clock"}) == ["store.json"]


def test_run_whose_last_request_is_lost_fails(
    own_objects: ObjectStore, recording: Path, tmp_path: Path
) -> None:
    own_objects.fail_after(0, containing="PUT /bucket/store/catalog")
    result = ingest("run", job(tmp_path, str(recording), own_objects.url("store")), cwd=tmp_path)
    assert result.returncode == 1
    assert "does not respond" in result.stderr


def test_two_writers_of_one_name_exclude_each_other(url: str) -> None:
    writers = [_write(url, "fail", source) for source in (1, 2)]
    codes = sorted(map(_ended, writers))
    store = Store.open(url, create=False)
    if codes == [0, 1]:
        sources = set(store.scan("drive", "/t0").read_all()["source"].to_pylist())
        assert len(sources) == 1
    else:
        assert codes == [1, 1], "both may give way, but not both may win"
        assert store.names() == ()


def test_writer_with_expired_heartbeat_does_not_commit(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sink = StoreSink(Store.open(url))
    with pytest.raises(SinkUnavailable, match="no heartbeat"), sink.open("s", {}) as session:
        session.topic("/t", POINT, {}).write(POINTS)
        monkeypatch.setattr("mosaico_ingest.destinations.store.files._SILENT_S", -1.0)
    assert [key for key in keys(url) if key.startswith(("segments/", "catalog/"))] == []


def test_store_of_a_later_format_is_refused_unchanged(url: str) -> None:
    (root_of(url) / "store.json").write_bytes(b'{"format": 2}')
    with pytest.raises(SinkError, match="the store has format 2, this version supports up to 1"):
        Store.open(url)


def test_missing_store_is_an_error(url: str) -> None:
    assert Store.find(root_of(url)) is None
    with pytest.raises(SinkError, match="there is no store here"):
        Store.open(url, create=False)


def test_damaged_catalog_document_is_named(url: str) -> None:
    store = Store.open(url)
    store.create_sequence("s", {})
    (root_of(url) / "catalog/s.json").write_bytes(b"{")
    with pytest.raises(SinkError, match=r"catalog/s\.json: the document cannot be read"):
        store.sequence("s")


def test_serve_refuses_a_store_by_url(url: str) -> None:
    with pytest.raises(SinkError, match="only a store in a local folder can be served"):
        serve(url)


def test_compaction_keeps_rows_and_checksum_and_gc_removes_replaced_objects(url: str) -> None:
    store = Store.open(url)
    for _ in range(3):
        with StoreSink(store).open("s", {}, if_exists=IfExists.APPEND) as session:
            session.topic("/t", POINT, {}).write(POINTS)
    rows, checksum = store.scan("s", "/t").read_all(), store.topic("s", "/t").checksum
    assert [result.problem for result in compact(store, store.sequence("s"))] == [None]
    assert store.scan("s", "/t").read_all().equals(rows)
    assert store.topic("s", "/t").checksum == checksum
    with pytest.raises(SinkError, match="compaction merged"):
        store.delete_session("s", store.sequence("s").sessions[0].id)
    store.collect_garbage()
    assert len([key for key in keys(url) if key.startswith("segments/")]) == 1
    assert store.scan("s", "/t").read_all().equals(rows)
