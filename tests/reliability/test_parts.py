"""Split recordings whose splits are empty, damaged or missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store

from .conftest import WriteBag, number

Ingest = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ingest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ingest:
    """Run the command; return its exit code, and standard output and error as one line each."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(ended.value.code or 0), out, err

    return run


@pytest.fixture
def parts(write_bag: WriteBag, tmp_path: Path) -> Path:
    """Three splits of two messages each, without metadata."""
    folder = tmp_path / "parts"
    folder.mkdir()
    for part in range(3):
        write_bag({"/std/speed": [number(2 * part), number(2 * part + 1)]}, name=f"part_{part}").rename(
            folder / f"part_{part}.db3"
        )
    return folder


def listing(folder: Path, count: int) -> None:
    names = ", ".join(f"part_{part}.db3" for part in range(count))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 5, storage_identifier: sqlite3, "
        f"relative_file_paths: [{names}], message_count: 6, topics_with_message_count: []}}"
    )


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "no database": lambda path: path.write_bytes(b"\xff" * 5000),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:100]),
}


@pytest.mark.parametrize("listed", [True, False], ids=["metadata", "no metadata"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_run_with_one_unreadable_split_ingests_the_others(
    damage: str, *, listed: bool, parts: Path, ingest: Ingest, tmp_path: Path
) -> None:
    DAMAGE[damage](parts / "part_1.db3")
    if listed:
        listing(parts, 3)
    code, out, err = ingest("inspect", "parts")
    assert code == 0
    assert "part_1.db3" in out + err
    assert "this split cannot be opened" in " ".join((out + err).split())
    code, out, err = ingest("bag", "parts", "--name", "drive", "--store", "store")
    assert code == 4
    assert "this split cannot be opened" in " ".join((out + err).split())
    rows = Store.open(tmp_path / "store").scan("drive", "/std/speed").read_all()
    assert sorted(rows["data"].to_pylist()) == [0, 1, 4, 5]


def test_run_with_missing_split_reports_it_and_exits_4(parts: Path, ingest: Ingest) -> None:
    (parts / "part_1.db3").unlink()
    listing(parts, 3)
    code, out, err = ingest("bag", "parts", "--name", "drive", "--store", "store")
    assert code == 4
    assert "part_1.db3" in out + err


@pytest.mark.parametrize("listed", [True, False], ids=["metadata", "no metadata"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_run_with_only_unreadable_splits_fails_with_one_error(
    damage: str, *, listed: bool, parts: Path, ingest: Ingest, tmp_path: Path
) -> None:
    for part in parts.glob("*.db3"):
        DAMAGE[damage](part)
    if listed:
        listing(parts, 3)
    for arguments in (("inspect", "parts"), ("bag", "parts", "--name", "drive", "--store", "store")):
        code, _, err = ingest(*arguments)
        assert code == 1, arguments
        (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
        assert "part_0.db3" in line
        assert "other 2 splits" in line
    assert not (tmp_path / "store").exists() or Store.open(tmp_path / "store").names() == ()


def test_run_of_empty_folder_fails_with_one_error(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    for arguments in (("inspect", "nothing"), ("bag", "nothing", "--name", "drive")):
        code, _, err = ingest(*arguments)
        assert code == 1
        assert "a directory without a recording; it holds nothing" in err
