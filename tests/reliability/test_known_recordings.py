"""Stored recordings are recognized by their fingerprints; opening and digesting all of them is the oracle."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given, settings
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pipeline import provenance as fingerprint
from mosaico_ingest.pipeline import task as opening
from mosaico_ingest.pipeline.provenance import known_recordings
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.services.status import Status

NUMBER = define("own_msgs/msg/Number", "float64 data")
START_NS = 1_700_000_000_000_000_000
ADAPTER = """\
version: 1
adapter: NumberAdapter
description: A number
ros_type: own_msgs/msg/Number
ontology:
  tag: OwnNumber
  fields:
    value: {type: float64, nullable: false}
fields:
  value: data
"""
NAMES = ("one", "two", "three")
Change = Callable[[Path, str], None]


def write_recording(path: Path, first: float) -> Path:
    messages = [("/number", NUMBER, START_NS + step, {"data": first + step}) for step in range(3)]
    return record(path, messages)


def write_fleet(folder: Path) -> Path:
    """Write two files, a directory of two splits, and a manifest that uses side-cars, an adapter and definitions."""
    data = folder / "data"
    (data / "three").mkdir(parents=True)
    (folder / "definitions").mkdir()
    (folder / "adapters").mkdir()
    for position, name in enumerate(NAMES[:2]):
        write_recording(data / f"{name}.mcap", position)
    for split in range(2):
        write_recording(data / "three" / f"three_{split}.mcap", 10 + split)
    write_metadata(data / "three", 6)
    (data / "one.json").write_text('{"driver": "a"}')
    (folder / "metadata.json").write_text('{"site": "yard"}')
    (folder / "definitions/Number.msg").write_text("float64 data")
    (folder / "adapters/number.yaml").write_text(ADAPTER)
    return write_manifest(folder)


def write_metadata(folder: Path, count: int) -> None:
    topic = {"name": "/number", "type": "own_msgs/msg/Number", "serialization_format": "cdr"}
    information = {
        "version": 5,
        "relative_file_paths": ["three_0.mcap", "three_1.mcap"],
        "message_count": count,
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": count}],
    }
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))


def write_manifest(folder: Path, **sections: object) -> Path:
    manifest = {
        "bag": {"path": "data/*", "custom_msgs": [{"package": "own_msgs", "path": "definitions"}]},
        "sequence": {
            "name": "{stem}",
            "if_exists": "skip",
            "metadata_file": "metadata.json",
            "metadata_from": {"sidecar": "{stem}.json"},
        },
        "adapters": {"load": ["adapters/number.yaml"]},
        "target": {"store": "store"},
        **sections,
    }
    job = folder / "job.yaml"
    job.write_text(yaml.safe_dump(manifest))
    return job


def file_of(folder: Path, name: str) -> Path:
    return folder / "data" / ("three/three_1.mcap" if name == "three" else f"{name}.mcap")


def rewrite_in_place(folder: Path, name: str) -> None:
    """Change one number; size, inode and time of modification stay."""
    file = file_of(folder, name)
    before = file.stat()
    content = file.read_bytes()
    with file.open("r+b") as opened:
        opened.write(content[:-40] + bytes([content[-40] ^ 1]) + content[-39:])
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


def replace_by_copy(folder: Path, name: str) -> None:
    file = file_of(folder, name)
    copy = file.with_name("copy.tmp")
    shutil.copyfile(file, copy)
    copy.replace(file)


def replace_by_other(folder: Path, name: str) -> None:
    """Put another recording of the same size and time of modification at the path."""
    file = file_of(folder, name)
    before = file.stat()
    other = write_recording(file.with_name("other.mcap"), 77)
    os.utime(other, ns=(before.st_atime_ns, before.st_mtime_ns))
    other.replace(file)


def exchange(folder: Path, _name: str) -> None:
    one, two, spare = file_of(folder, "one"), file_of(folder, "two"), folder / "spare"
    one.rename(spare)
    two.rename(one)
    spare.rename(two)


def append_bytes(folder: Path, name: str) -> None:
    with file_of(folder, name).open("ab") as file:
        file.write(b"\x00" * 9)


def rename_folder(folder: Path, _name: str) -> None:
    shutil.move(folder / "data", folder / "moved")
    shutil.copytree(folder / "moved", folder / "data")


def edit_store(statement: str) -> Change:
    def edit(folder: Path, name: str) -> None:
        with closing(sqlite3.connect(folder / "store/catalog.sqlite")) as db:
            db.execute("PRAGMA foreign_keys = ON")
            db.execute(statement, {"name": name})
            db.commit()

    return edit


CHANGES: dict[str, Change] = {
    "nothing": lambda _folder, _name: None,
    "touch": lambda folder, name: file_of(folder, name).touch(),
    "rewrite in place": rewrite_in_place,
    "replace by copy": replace_by_copy,
    "replace by other": replace_by_other,
    "exchange": exchange,
    "append": append_bytes,
    "truncate": lambda folder, name: os.truncate(file_of(folder, name), 900),
    "rename folder": rename_folder,
    "hard link": lambda folder, name: os.link(file_of(folder, name), folder / "link"),
    "permissions": lambda folder, name: file_of(folder, name).chmod(0o600),
    "more splits": lambda folder, _name: write_recording(folder / "data/three/three_2.mcap", 5) and None,
    "split removed": lambda folder, _name: (folder / "data/three/three_0.mcap").unlink(missing_ok=True),
    "metadata of splits": lambda folder, _name: write_metadata(folder / "data/three", 5),
    "metadata of files": lambda folder, _name: (folder / "data/metadata.yaml").write_text("x") and None,
    "side-car": lambda folder, name: (folder / f"data/{name}.json").write_text('{"driver": "b"}') and None,
    "no side-car": lambda folder, _name: (folder / "data/one.json").unlink(missing_ok=True),
    "metadata file": lambda folder, _name: (folder / "metadata.json").write_text('{"site": "hall"}') and None,
    "definition": lambda folder, _name: (
        (folder / "definitions/Number.msg").write_text("float64 data\nint8 more") and None
    ),
    "adapter": lambda folder, _name: (
        (folder / "adapters/number.yaml").write_text(ADAPTER.replace("value: data", "value: data * 2"))
        and None
    ),
    "adapter layout": lambda folder, _name: (
        (folder / "adapters/number.yaml").write_text(f"# a comment\n{ADAPTER}") and None
    ),
    "settings": lambda folder, _name: (
        write_manifest(folder, topic_settings={"/number": {"every": 2}}) and None
    ),
    "quarantine": lambda folder, _name: write_manifest(folder, quarantine={"max": 3}) and None,
    "run options": lambda folder, _name: write_manifest(folder, run={"jobs": 2, "memory": "1GiB"}) and None,
    "comment": lambda folder, _name: (
        (folder / "job.yaml").write_text("# a comment\n" + (folder / "job.yaml").read_text()) and None
    ),
    "sequence deleted": edit_store("DELETE FROM sequences WHERE name = :name"),
    "sessions deleted": edit_store(
        "DELETE FROM sessions WHERE sequence_id IN (SELECT id FROM sequences WHERE name = :name)"
    ),
    "error noted": edit_store(
        "INSERT INTO notes (sequence_id, message, created_ns) SELECT id, 'stopped', 1 FROM sequences WHERE name = :name"
    ),
    "provenance replaced": edit_store(
        "UPDATE sessions SET metadata = '{}' WHERE sequence_id IN (SELECT id FROM sequences WHERE name = :name)"
    ),
    "sequence renamed": edit_store("UPDATE sequences SET name = 'other' WHERE name = :name"),
}
HARMLESS = {"nothing", "run options", "comment"}
"""Changes after which every recording is recognized without opening it."""


def check(job: Path) -> None:
    """Compare the fast statuses with the slow ones, and require that each recognized recording is done."""
    slow = api.job_status(job, verify=True)
    assert api.job_status(job) == slow
    known = known_recordings(api.compile_job(job))
    assert [status.sequence for status, is_known in zip(slow, known, strict=True) if is_known] == [
        status.sequence
        for status, is_known in zip(slow, known, strict=True)
        if is_known and status.status is Status.DONE
    ]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fleet(tmp_path_factory.mktemp("fleet")).parent


@given(
    changes=st.lists(
        st.tuples(st.sampled_from(sorted(CHANGES)), st.sampled_from(NAMES)),
        max_size=4,
        unique_by=lambda one: one[0],
    ),
)
@settings(max_examples=25, deadline=None)
def test_status_after_any_changes_equals_that_of_opening_every_recording(
    fleet: Path, tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[str, str]]
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fingerprint, "_SETTLED_NS", 0)  # no test changes a file within a tick of the clock
        folder = tmp_path_factory.mktemp("changes")
        shutil.copytree(fleet, folder, dirs_exist_ok=True)
        job = folder / "job.yaml"
        reports = api.run(job).recordings
        assert {report.status for report in reports} == {RunStatus.COMPLETED}
        assert known_recordings(api.compile_job(job)) == [True] * 3
        for change, name in changes:
            try:
                CHANGES[change](folder, name)
            except FileNotFoundError:  # an earlier change removed the file
                continue
            check(job)
        if {change for change, _ in changes} <= HARMLESS:
            assert known_recordings(api.compile_job(job)) == [True] * 3


@pytest.mark.parametrize("change", ["nothing", "touch", "replace by other", "adapter", "error noted"])
def test_run_after_change_skips_same_recordings_as_with_verify(
    fleet: Path, tmp_path: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fingerprint, "_SETTLED_NS", 0)
    outcomes: list[list[RunStatus]] = []
    for verify in (False, True):
        folder = tmp_path / str(verify)
        shutil.copytree(fleet, folder)
        api.run(folder / "job.yaml")
        CHANGES[change](folder, "one")
        outcomes.append([one.status for one in api.run(folder / "job.yaml", verify=verify).recordings])
    assert outcomes[0] == outcomes[1]


def test_run_of_known_recordings_opens_none(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fingerprint, "_SETTLED_NS", 0)
    shutil.copytree(fleet, tmp_path, dirs_exist_ok=True)
    job = tmp_path / "job.yaml"
    api.run(job)

    def open_none(*_arguments: object, **_options: object) -> None:
        raise AssertionError("a recording was opened")

    monkeypatch.setattr(opening, "open_recording", open_none)
    report = api.run(job)
    assert [one.status for one in report.recordings] == [RunStatus.SKIPPED] * 3
    assert report.exit_code == 0
    assert [one.status for one in api.job_status(job)] == [Status.DONE] * 3


def test_fingerprint_of_recently_changed_recording_is_unknown(fleet: Path, tmp_path: Path) -> None:
    shutil.copytree(fleet, tmp_path, dirs_exist_ok=True)
    (tmp_path / "data/one.mcap").touch()
    job = api.compile_job(tmp_path / "job.yaml")[0]
    assert fingerprint.fingerprint(job) is None
    past_ns = 1_600_000_000_000_000_000
    state = ("/a", "1", str(past_ns), str(past_ns), "1")
    assert not fingerprint._changed_recently([state])


@pytest.mark.parametrize(
    "sections",
    [
        {"on_schema_change": "evolve"},
        {"expect": {"group": {"files": ["one.mcap"]}}},
    ],
)
def test_fingerprint_of_job_that_depends_on_other_recordings_is_unknown(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sections: dict[str, object]
) -> None:
    monkeypatch.setattr(fingerprint, "_SETTLED_NS", 0)
    shutil.copytree(fleet, tmp_path, dirs_exist_ok=True)
    assert fingerprint.fingerprint(api.compile_job(tmp_path / "job.yaml")[0]) is not None
    job = write_manifest(tmp_path, **sections)
    assert fingerprint.fingerprint(api.compile_job(job)[0]) is None


def test_known_recordings_of_unreadable_store_are_none(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fingerprint, "_SETTLED_NS", 0)
    shutil.copytree(fleet, tmp_path, dirs_exist_ok=True)
    job = tmp_path / "job.yaml"
    api.run(job)
    assert Store.open(tmp_path / "store").names() == ("one", "three", "two")
    (tmp_path / "store/catalog.sqlite").write_bytes(b"no database")
    assert known_recordings(api.compile_job(job)) == [False] * 3
    assert api.job_status(job) == api.job_status(job, verify=True)
