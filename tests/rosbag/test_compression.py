"""Decompression checks the announced sizes of chunks and reports damaged data."""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.compression import (
    CompressedChunk,
    decompress,
    decompress_chunks,
    decompress_file,
    decompress_message,
    decompress_partially,
)

PACK: dict[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "bz2": bz2.compress,
}
DATA = os.urandom(50_000).hex().encode() + bytes(50_000)
_BETWEEN = b"between"


@pytest.mark.parametrize("name", PACK)
def test_decompress_intact_chunk_returns_original(name: str) -> None:
    assert bytes(decompress(PACK[name](DATA), name, len(DATA))) == DATA
    assert decompress_partially(PACK[name](DATA), name, len(DATA)).tobytes() == DATA


@pytest.mark.parametrize("name", PACK)
@pytest.mark.parametrize("size", [0, 10, len(DATA) - 1, len(DATA) + 1, 1 << 50])
def test_decompress_wrong_announced_size_raises(name: str, size: int) -> None:
    with pytest.raises(BagError, match="announce"):
        decompress(PACK[name](DATA), name, size)


@pytest.mark.parametrize("name", ["zstd", "lz4", "bz2"])
def test_decompress_damaged_chunk_raises_and_partial_returns_prefix(name: str) -> None:
    packed = PACK[name](DATA)
    with pytest.raises(BagError):
        decompress(packed[:4] + b"\xff" * (len(packed) - 4), name, len(DATA))
    with pytest.raises(BagError):
        decompress(packed[: len(packed) // 2], name, len(DATA))
    assert DATA.startswith(decompress_partially(packed[: len(packed) // 2], name, len(DATA)).tobytes())


def test_decompress_more_than_announced_raises() -> None:
    bomb = zstandard.compress(bytes(64 << 20))
    with pytest.raises(BagError, match="1048576 bytes announced"):
        decompress(bomb, "zstd", 1 << 20)
    with pytest.raises(BagError, match="more than 1000 bytes"):
        decompress_message(bomb, 1000)
    assert len(decompress_partially(bomb, "zstd", 1 << 20)) == 1 << 20


def test_decompress_unknown_compression_raises() -> None:
    with pytest.raises(
        BagError, match="compression 'snappy' is unknown; the supported ones are none, zstd, lz4, bz2"
    ):
        decompress(b"x", "snappy", 1)


def test_decompress_file_several_frames_concatenates_them(tmp_path: Path) -> None:
    packed, plain = tmp_path / "a.zstd", tmp_path / "a"
    packed.write_bytes(zstandard.compress(DATA) + zstandard.compress(b"more"))
    assert decompress_file(packed, plain) is None
    assert plain.read_bytes() == DATA + b"more"
    packed.write_bytes(packed.read_bytes()[:-8])
    assert decompress_file(packed, plain) == "the zstd file is truncated"
    packed.write_bytes(zstandard.compress(DATA)[:4] + b"\xff" * 5000)
    assert str(decompress_file(packed, plain)).startswith("damaged zstd file")


def _packed(chunks: Sequence[tuple[str, bytes, int]]) -> tuple[NDArray[np.uint8], list[CompressedChunk]]:
    """Return a buffer with the chunks, each after other bytes, and their offsets in it."""
    data, packed = b"", list[CompressedChunk]()
    for name, contents, size in chunks:
        begin = len(data) + len(_BETWEEN)
        data += _BETWEEN + contents
        packed.append(CompressedChunk(begin, len(data), name, size))
    return np.frombuffer(data, np.uint8), packed


def _decompress_all(chunks: Sequence[tuple[str, bytes, int]]) -> tuple[list[bytes], dict[int, BagError]]:
    actual = decompress_chunks(*_packed(chunks))
    contents = [actual.data[begin:end].tobytes() for begin, end in actual.bounds]
    return contents, actual.errors


@given(
    chunks=st.lists(st.tuples(st.sampled_from(sorted(PACK)), st.binary(max_size=3000)), max_size=6),
    more=st.integers(0, 3),
    one=st.none() | st.sampled_from(sorted(PACK)),
)
def test_decompress_chunks_several_equal_individual_results(
    chunks: list[tuple[str, bytes]], more: int, one: str | None
) -> None:
    messages = [(one or name, data * (1 + more)) for name, data in chunks]
    actual, failures = _decompress_all([(name, PACK[name](data), len(data)) for name, data in messages])
    assert not failures
    assert actual == [data for _, data in messages]


def test_decompress_chunks_plain_returns_same_buffer() -> None:
    data, packed = _packed([("", b"one", 3), ("none", b"other", 5)])
    assert decompress_chunks(data, packed).data is data


@pytest.mark.parametrize("name", PACK)
@pytest.mark.parametrize("size", [0, 10, len(DATA) - 1, len(DATA) + 1, 1 << 50, (1 << 64) - 1])
def test_decompress_chunks_one_damaged_returns_others(name: str, size: int) -> None:
    chunks = [(b"before", 6), (DATA, size), (b"after", 5)]
    actual, failures = _decompress_all([(name, PACK[name](data), announced) for data, announced in chunks])
    assert list(failures) == [1]
    assert "announced" in failures[1].what
    assert (actual[0], actual[2]) == (b"before", b"after")


@pytest.mark.parametrize("cut", [1, 5, 1000])
@pytest.mark.parametrize("name", ["zstd", "lz4"])
def test_decompress_chunks_one_truncated_returns_others(name: str, cut: int) -> None:
    whole = PACK[name](DATA)
    assert list(_decompress_all([(name, contents, len(DATA)) for contents in (whole, whole[:-cut])])[1]) == [
        1
    ]
