"""Full and read-only disks: one error line, an unchanged store, and a next run that completes."""

from __future__ import annotations

import os
import random
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zstandard
from disks import MEBIBYTE, filled, read_only, small_disk

from mosaico_ingest.destinations.store import Store

from .conftest import CUT, WriteBag, number

pytestmark = pytest.mark.slow

WriteJob = Callable[..., Path]
REPLACE = {"name": "drive", "if_exists": "replace"}


def ran(*arguments: object, **environment: str) -> tuple[int, str]:
    """Run the command; return its exit code and standard error."""
    result = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, **environment},
    )
    assert "Traceback" not in result.stderr, result.stderr
    return result.returncode, result.stderr


def the_error(said: str) -> str:
    """Return the only error line."""
    (line,) = [line for line in said.splitlines() if line.startswith("error: ")]
    return line


def speeds(store: Path) -> list[float]:
    return Store.open(store, create=False).scan("drive", "/speed").read_all()["data"].to_pylist()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MiB."""
    with small_disk(tmp_path / "small", 2 * MEBIBYTE) as folder:
        yield folder


@pytest.fixture
def noise() -> list[bytes]:
    """Incompressible numbers: 640 kB in a recording and at least as much in a store."""
    source = random.Random(1)  # noqa: S311 - they only must not compress
    return [number(struct.unpack("<d", struct.pack("<Q", source.getrandbits(62)))[0]) for _ in range(80_000)]


@pytest.mark.slow
def test_replacing_run_on_full_disk_names_cause_and_keeps_old_sequence(
    write_bag: WriteBag, write_job: WriteJob, disk: Path, noise: list[bytes]
) -> None:
    store = disk / "store"
    job = write_job(sequence=REPLACE, target={"store": str(store)})
    write_bag({"/speed": [number(1)]})
    assert ran("run", "-q", job)[0] == 0
    (job.parent / "drive.db3").unlink()
    write_bag({"/speed": noise})
    with filled(disk, free_bytes=300_000):
        code, output = ran("run", "-q", job)
        assert code == 1
        assert "No space left" in the_error(output)
        assert "free some space" in the_error(output)
        assert speeds(store) == [1.0]
        assert len(list(store.rglob("*.parquet"))) == 1
        assert ran("verify", "--store", store)[0] == 0
    assert ran("run", "-q", job) == (0, "")
    assert len(speeds(store)) == len(noise)


@pytest.mark.slow
@pytest.mark.parametrize("left_bytes", [0, 4096, 40_000, 110_000, 200_000])
def test_first_run_on_full_disk_publishes_nothing(
    left_bytes: int, write_bag: WriteBag, write_job: WriteJob, disk: Path, noise: list[bytes]
) -> None:
    store = disk / "store"
    job = write_job(target={"store": str(store)})
    write_bag({"/speed": noise})
    with filled(disk, free_bytes=left_bytes):
        code, output = ran("run", "-q", job)
        assert code == 1
        assert str(disk) in the_error(output)
    assert not list(store.rglob("*.parquet"))
    assert ran("run", "-q", job) == (0, "")
    assert len(speeds(store)) == len(noise)


@pytest.mark.slow
def test_read_only_store_refuses_writes_and_allows_reads(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    job = write_job(sequence=REPLACE)
    write_bag({"/speed": [number(1)]})
    assert ran("run", "-q", job)[0] == 0
    (tmp_path / "drive.db3").unlink()
    write_bag({"/speed": [number(2)]})
    with read_only(store):
        code, output = ran("run", "-q", job)
        assert code == 1
        assert str(store) in the_error(output)
        assert speeds(store) == [1.0]
        for reading in (("store", "ls"), ("store", "show", "drive"), ("verify",)):
            assert ran(*reading, "--store", store)[0] == 0
        for writing in (("store", "rm", "drive", "--yes"), ("store", "gc")):
            code, output = ran(*writing, "--store", store)
            assert code == 1, writing
            assert str(store) in the_error(output)
    assert ran("run", "-q", job) == (0, "")
    assert speeds(store) == [2.0]


def test_run_with_full_quarantine_disk_fails_and_publishes_nothing(
    write_bag: WriteBag, write_job: WriteJob, disk: Path, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1), CUT, number(2)]})
    job = write_job(quarantine={"path": str(disk / "quarantine")})
    with filled(disk):
        code, output = ran("run", "-q", job)
        assert code == 1
        assert str(disk) in the_error(output)
    assert "drive" not in Store.open(tmp_path / "store").names()
    assert ran("run", "-q", job)[0] == 4
    assert speeds(tmp_path / "store") == [1.0, 2.0]


def test_run_with_full_report_disk_fails_after_commit(
    write_bag: WriteBag, write_job: WriteJob, disk: Path, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    with filled(disk):
        code, output = ran("run", "-q", write_job(), "--report", disk / "run.json")
    assert code == 1
    assert str(disk / "run.json") in the_error(output)
    assert speeds(tmp_path / "store") == [1.0]


def test_run_with_full_temporary_folder_names_tmpdir(
    write_bag: WriteBag, write_job: WriteJob, disk: Path, tmp_path: Path, noise: list[bytes]
) -> None:
    packed = tmp_path / "packed.db3.zstd"
    packed.write_bytes(zstandard.compress(write_bag({"/speed": noise}).read_bytes()))
    custom = [{"package": "own_msgs", "path": "definitions"}]
    job = write_job(bag={"path": packed.name, "custom_msgs": custom})
    with filled(disk, free_bytes=100_000):
        code, output = ran("run", "-q", job, TMPDIR=str(disk))
        assert code == 1
        assert "cannot be decompressed" in the_error(output)
        assert "TMPDIR" in the_error(output)
        assert {path.name for path in disk.iterdir()} == {"ballast"}
    assert ran("run", "-q", job, TMPDIR=str(tmp_path)) == (0, "")
    assert len(speeds(tmp_path / "store")) == len(noise)
