"""A checksum of row values that does not depend on files, row groups and batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from xxhash import xxh3_128, xxh3_128_digest


def column_makers(schema: pa.Schema) -> tuple[ColumnMaker, ...]:
    """Return a factory of the hash state of each column."""
    return tuple(_maker(field.type) for field in schema)


class ContentHash:
    """XXH3 (128 bits) over the columns of successive tables.

    The checksum of a column covers which values are null, the lengths of lists and texts, and the bytes of values that
    are not null. It does not depend on the memory behind nulls, on the division into chunks, or on the file encoding.
    """

    def __init__(self, makers: tuple[ColumnMaker, ...]) -> None:
        self._columns = [make() for make in makers]

    def add(self, rows: pa.Table | pa.RecordBatch) -> None:
        """Add the next rows."""
        for column, values in zip(self._columns, rows.columns, strict=True):
            for chunk in values.chunks if isinstance(values, pa.ChunkedArray) else (values,):
                if len(chunk):
                    column.add(chunk)

    def hexdigest(self) -> str:
        """Return the checksum of all rows so far, 32 hexadecimal digits."""
        return xxh3_128(b"".join(column.digest() for column in self._columns)).hexdigest()


def combined(checksums: Iterable[str | None]) -> str | None:
    """Return one checksum for the rows of several segments, or None if there are none or one is missing."""
    values = list(checksums)
    present = [value for value in values if value is not None]
    if not present or len(present) < len(values):
        return None
    return present[0] if len(present) == 1 else xxh3_128("".join(present).encode()).hexdigest()


class _Column(Protocol):
    def add(self, array: pa.Array[Any]) -> None:
        """Add one chunk that is not empty."""
        ...

    def add_nulls(self, count: int) -> None:
        """Add a chunk in which every value is null."""
        ...

    def digest(self) -> bytes: ...


ColumnMaker: TypeAlias = Callable[[], _Column]
"""Creates the hash state of one column."""


class _Bytes:
    """A hash of bytes in pieces, created with the first piece, since many columns have no bytes."""

    def __init__(self) -> None:
        self._hash: Any = None

    def update(self, piece: bytes | memoryview) -> None:
        if self._hash is None:
            self._hash = xxh3_128()
        self._hash.update(piece)

    def digest(self, end: bytes = b"") -> bytes:
        """Return the checksum of all pieces so far and `end`."""
        if self._hash is None:
            return xxh3_128_digest(end)
        ended = self._hash.copy()
        ended.update(end)
        return ended.digest()


class _Nulls:
    """The positions of nulls, as the lengths of alternating runs of values and nulls."""

    def __init__(self) -> None:
        self._hash = _Bytes()
        self._valid = True
        self._run = 0

    def add(self, array: pa.Array[Any]) -> int:
        """Add a chunk and return its number of nulls."""
        nulls = array.null_count
        if not nulls or nulls == len(array):
            self.extend_by(len(array), valid=not nulls)
            return nulls
        valid = array.is_valid().to_numpy(zero_copy_only=False)
        edges = np.flatnonzero(valid[1:] != valid[:-1]) + 1
        self._extend(np.diff(edges, prepend=0, append=len(array)), valid=bool(valid[0]))
        return nulls

    def present(self, array: pa.Array[Any]) -> Any:  # noqa: ANN401 - any Arrow array; the stubs have no common base
        """Add a chunk and return its values without nulls, or None if all are null."""
        nulls = self.add(array)
        if nulls == len(array):
            return None
        return array.drop_null() if nulls else array

    def digest(self) -> bytes:
        return self._hash.digest(self._run.to_bytes(8, "little"))

    def extend_by(self, run: int, *, valid: bool) -> None:
        """Append one run; most chunks are one run."""
        if valid is self._valid:
            self._run += run
        else:
            self._hash.update(self._run.to_bytes(8, "little"))
            self._valid, self._run = valid, run

    def _extend(self, runs: NDArray[np.int64], *, valid: bool) -> None:
        """Append alternating runs; the last one stays open because the next chunk may continue it."""
        if valid is self._valid:
            runs[0] += self._run
        else:
            self._hash.update(self._run.to_bytes(8, "little"))
        self._hash.update(runs[:-1].astype("<i8").tobytes())
        self._valid = valid if len(runs) % 2 else not valid
        self._run = int(runs[-1])


class _Numbers:
    """Values of fixed width."""

    def __init__(self) -> None:
        self._nulls = _Nulls()
        self._hash = _Bytes()

    def add(self, array: pa.Array[Any]) -> None:
        values = self._nulls.present(array)
        if values is not None:
            width = values.type.bit_width // 8
            self._hash.update(_piece(values.buffers()[1], values.offset * width, len(values) * width))

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._hash.digest()


class _Texts:
    """Values of variable length."""

    def __init__(self, offset: type[np.int32 | np.int64]) -> None:
        self._nulls = _Nulls()
        self._lengths = _Bytes()
        self._hash = _Bytes()
        self._offset = np.dtype(offset)

    def add(self, array: pa.Array[Any]) -> None:
        values = self._nulls.present(array)
        if values is None:
            return
        _, offsets, data = values.buffers()
        width = self._offset.itemsize
        ends = np.frombuffer(_piece(offsets, values.offset * width, (len(values) + 1) * width), self._offset)
        self._lengths.update(np.diff(ends).astype("<i8").tobytes())
        self._hash.update(_piece(data, int(ends[0]), int(ends[-1] - ends[0])))

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._lengths.digest() + self._hash.digest()


class _Lists:
    """Lists of variable or fixed length."""

    def __init__(self, items: ColumnMaker) -> None:
        self._nulls = _Nulls()
        self._lengths = _Bytes()
        self._items = items()

    def add(self, array: pa.Array[Any]) -> None:
        lists = self._nulls.present(array)
        if lists is None:
            return
        if isinstance(lists, pa.ListArray | pa.LargeListArray):
            self._lengths.update(np.diff(lists.offsets.to_numpy()).astype("<i8").tobytes())
        items = lists.flatten()
        if len(items):
            self._items.add(items)

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._lengths.digest() + self._items.digest()


class _Structs:
    """Structs; the fields of a null struct are null."""

    def __init__(self, fields: tuple[ColumnMaker, ...]) -> None:
        self._nulls = _Nulls()
        self._fields = [make() for make in fields]

    def add(self, array: pa.Array[Any]) -> None:
        if self._nulls.add(array) == len(array):
            for field in self._fields:
                field.add_nulls(len(array))
            return
        structs: Any = array
        for field, values in zip(self._fields, structs.flatten(), strict=True):
            field.add(values)

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)
        for field in self._fields:
            field.add_nulls(count)

    def digest(self) -> bytes:
        return self._nulls.digest() + b"".join(field.digest() for field in self._fields)


class _Converted:
    """Values that are hashed after a cast to another type."""

    def __init__(self, kind: pa.DataType, make: ColumnMaker) -> None:
        self._kind = kind
        self._values = make()

    def add(self, array: pa.Array[Any]) -> None:
        self._values.add(array.cast(self._kind))

    def add_nulls(self, count: int) -> None:
        self._values.add_nulls(count)

    def digest(self) -> bytes:
        return self._values.digest()


def _maker(kind: Any) -> ColumnMaker:  # noqa: ANN401 - any Arrow type; the stubs have no common base with children
    """Return the factory of the hash state for a type."""
    if isinstance(kind, pa.StructType):
        return partial(_Structs, tuple(_maker(field.type) for field in kind))
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
        return partial(_Lists, _maker(kind.value_type))
    if isinstance(kind, pa.MapType):  # as a list of its entries
        return _converted(pa.list_(pa.struct([kind.key_field, kind.item_field])))
    if isinstance(kind, pa.DictionaryType):
        return _converted(kind.value_type)
    return _PLAIN.get(kind, _Numbers)


def _converted(kind: pa.DataType) -> ColumnMaker:
    return partial(_Converted, kind, _maker(kind))


_PLAIN: dict[pa.DataType, ColumnMaker] = {
    pa.string(): partial(_Texts, np.int32),
    pa.large_string(): partial(_Texts, np.int64),
    pa.binary(): partial(_Texts, np.int32),
    pa.large_binary(): partial(_Texts, np.int64),
    pa.string_view(): partial(_Converted, pa.large_binary(), partial(_Texts, np.int64)),
    pa.binary_view(): partial(_Converted, pa.large_binary(), partial(_Texts, np.int64)),
    pa.bool_(): partial(_Converted, pa.uint8(), _Numbers),
}


def _piece(buffer: pa.Buffer | None, start: int, size: int) -> memoryview:
    return memoryview(buffer)[start : start + size] if buffer is not None else memoryview(b"")
