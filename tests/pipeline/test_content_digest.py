from __future__ import annotations

from pathlib import Path

import pytest

from mosaico_ingest.pipeline.provenance import content_digest, full_digest

MIB = 1 << 20


def sparse(path: Path, size: int, *marks: int) -> Path:
    with path.open("wb") as file:
        file.truncate(size)
        for mark in marks:
            file.seek(mark)
            file.write(b"x")
    return path


@pytest.mark.parametrize("size", [0, 1, MIB - 1, MIB, 3 * MIB + 5])
def test_content_digest_of_copy_is_equal_and_of_longer_file_differs(tmp_path: Path, size: int) -> None:
    one, other = sparse(tmp_path / "a", size), sparse(tmp_path / "b", size)
    assert content_digest(one) == content_digest(other)
    assert content_digest(one) != content_digest(sparse(tmp_path / "c", size + 1))


@pytest.mark.parametrize("mark", [0, MIB - 1, MIB, 2 * MIB, 3 * MIB + 4])
def test_content_digest_depends_on_any_byte_of_short_file(tmp_path: Path, mark: int) -> None:
    size = 3 * MIB + 5
    assert content_digest(sparse(tmp_path / "a", size)) != content_digest(sparse(tmp_path / "b", size, mark))


@pytest.mark.parametrize("mark", [0, 300 * MIB - 1])
def test_content_digest_depends_on_first_and_last_byte_of_long_file(tmp_path: Path, mark: int) -> None:
    size = 300 * MIB
    assert content_digest(sparse(tmp_path / "a", size)) != content_digest(sparse(tmp_path / "b", size, mark))


@pytest.mark.parametrize("mark", [100 * MIB, 131 * MIB + 7, 300 * MIB - 2])
def test_full_digest_depends_on_every_byte(tmp_path: Path, mark: int) -> None:
    size = 300 * MIB
    one, other = sparse(tmp_path / "a", size), sparse(tmp_path / "b", size, mark)
    assert full_digest(one) != full_digest(other)
    assert full_digest(one) == full_digest(sparse(tmp_path / "c", size))


def test_full_digest_of_short_file_is_none(tmp_path: Path) -> None:
    assert full_digest(sparse(tmp_path / "a", 64 * MIB)) is None
    assert full_digest(sparse(tmp_path / "b", 64 * MIB + 1)) is not None
