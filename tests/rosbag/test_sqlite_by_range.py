"""`.db3` files behind URLs: the same messages and the same damage as from the local file, with few requests."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from web_server import WebServer, web_server

from mosaico_ingest.errors import BagError, Unreachable
from mosaico_ingest.remote import AnyPath, Network, RemotePath, as_path, with_network
from mosaico_ingest.rosbag.recording import Recording, open_recording

from .test_sqlite_mutations import Intact, intact, mutate

__all__ = ["intact"]
PAGE_BYTES = 256 << 10
"""Size of the smallest request."""


@pytest.fixture
def server() -> Iterator[WebServer]:
    with web_server() as running:
        yield running


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 MB: 600 messages of 20 kB, and 60,000 small ones of another topic."""
    path = tmp_path_factory.mktemp("large") / "large.db3"
    rng = random.Random(1)  # noqa: S311 - test data
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        database.executemany(
            "INSERT INTO topics VALUES (?, ?, 'std_msgs/msg/Empty')", [(1, "/large"), (2, "/small")]
        )
        rows = (
            (1 + (row % 101 > 0), row, rng.randbytes(8 if row % 101 else 20_000)) for row in range(60_600)
        )
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    return path


def serve(server: WebServer, name: str, content: bytes, **network: Any) -> RemotePath:
    server.files[name] = content
    path = with_network(as_path(server.url(name)), Network(attempts=1, **network))
    assert isinstance(path, RemotePath)
    return path


def content_of(recording: Recording, **selection: int) -> list[tuple[str, int, bytes]]:
    topics = {connection.id: connection.topic for connection in recording.connections}
    return sorted(
        (topics[block.connection], int(time_ns), block.payload(row))
        for block in recording.message_blocks(**selection)
        for row, time_ns in enumerate(block.log_times)
    )


def outcome(path: AnyPath, recordings: Any) -> tuple[list[tuple[str, int, bytes]], bool] | None:
    """Return the messages, and whether some are unreadable; None if the file cannot be opened."""
    try:
        with open_recording(path, resolve=recordings.blind) as recording:
            return content_of(recording), bool(recording.unreadable)
    except BagError:
        return None


def test_sqlite_faults_by_range_are_read_and_reported_as_in_the_local_file(
    server: WebServer, recordings: Any, intact: Intact, tmp_path: Path
) -> None:
    local = tmp_path / "damaged.db3"
    for seed in [*range(10), 280, 302, 308, 315]:  # the last ones: a row more, truncated, shifted, two gaps
        fault, content = mutate(intact.content, random.Random(seed))  # noqa: S311 - test data
        local.write_bytes(content)
        here = outcome(local, recordings)
        there = outcome(serve(server, f"{seed}.db3", content), recordings)
        if here is None or there is None:
            assert here == there, f"seed {seed}: {fault}"
            continue
        # Before an error, the two libraries may return a different number of rows.
        assert set(here[0]) <= set(there[0]), f"seed {seed}: {fault}"
        assert len(there[0]) <= len(here[0]) + 1, f"seed {seed}: {fault}"
        assert here[1] == there[1], f"seed {seed}: {fault}"


def test_sqlite_complete_read_by_range_needs_few_requests_and_each_byte_once(
    server: WebServer, recordings: Any, large: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        assert len(server.requests) <= 12
        assert server.sent_bytes <= 5 * PAGE_BYTES
        assert (there.start_ns, there.end_ns) == (0, 60_599)
        with open_recording(large, resolve=recordings.blind) as here:
            assert content_of(there) == content_of(here)
        assert there.unreadable == ()
    assert len(server.requests) <= 30
    assert server.sent_bytes <= large.stat().st_size + 2 * PAGE_BYTES
    assert not list(tmp_path.iterdir())


def test_sqlite_time_range_by_range_reads_a_part(server: WebServer, recordings: Any, large: Path) -> None:
    remote = serve(server, "large.db3", large.read_bytes())
    selection = {"start_ns": 30_000, "end_ns": 31_000}
    with (
        open_recording(remote, resolve=recordings.blind) as there,
        open_recording(large, resolve=recordings.blind) as here,
    ):
        assert content_of(there, **selection) == content_of(here, **selection)
    assert server.sent_bytes <= large.stat().st_size / 4


def test_sqlite_reader_stops_at_the_end_of_the_sample(
    server: WebServer, recordings: Any, large: Path
) -> None:
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        blocks = there.message_blocks([1], max_rows=16)
        assert len(next(blocks)) == 16
    assert server.sent_bytes <= large.stat().st_size / 4


def test_sqlite_by_range_without_response_is_unreachable(
    server: WebServer, recordings: Any, large: Path
) -> None:
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        server.failures = [503] * 20
        with pytest.raises(Unreachable, match="503"):
            content_of(there)


def test_sqlite_replaced_while_it_is_read_is_unreachable(
    server: WebServer, recordings: Any, large: Path
) -> None:
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        server.tag = "v2"
        with pytest.raises(Unreachable, match="changed"):
            content_of(there)


def test_sqlite_of_server_without_ranges_is_downloaded_once(
    server: WebServer, recordings: Any, large: Path
) -> None:
    server.ranges = False
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        assert there.message_count == 60_600
        assert any("the server ignores ranges" in finding.message for finding in there.findings)
    downloads = [byte_range for _, byte_range in server.requests if byte_range != "bytes=0-0"]
    assert len(downloads) == 2  # the head, and the file


def test_sqlite_of_server_without_ranges_larger_than_max_download_is_refused(
    server: WebServer, recordings: Any, large: Path
) -> None:
    server.ranges = False
    remote = serve(server, "large.db3", large.read_bytes(), max_download_bytes=1 << 20)
    with pytest.raises(BagError, match=r"network\.max_download is 1048576"):
        open_recording(remote, resolve=recordings.blind)


def test_sqlite_without_apsw_is_downloaded_with_a_note_that_names_the_extra(
    server: WebServer, recordings: Any, large: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mosaico_ingest.rosbag.discovery.find_spec", lambda _: None)
    remote = serve(server, "large.db3", large.read_bytes())
    with open_recording(remote, resolve=recordings.blind) as there:
        assert there.message_count == 60_600
        assert any("mosaico-ingest[remote]" in finding.message for finding in there.findings)
