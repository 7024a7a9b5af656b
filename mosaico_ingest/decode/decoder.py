"""Decoders of one connection: columnar, with row-wise decoding as fallback and reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.decode.layout import (
    PADDING,
    Array,
    BodyOffsets,
    Cells,
    Column,
    FixedArrayColumn,
    FixedBlock,
    Layout,
    ListColumn,
    LocatedMessages,
    Loop,
    NumberColumn,
    Payloads,
    Run,
    Step,
    StepOffsets,
    StructColumn,
    TextColumn,
    array_of,
    bytes_at,
    compile_layout,
    copy_slices,
    expand_ranges,
    fixed_cells,
    list_offsets,
)
from mosaico_ingest.decode.locate import locate
from mosaico_ingest.errors import DecodeError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.rosbag.blocks import Connection, Encoding, Int64s, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import NUMBERS, ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Language
from mosaico_ingest.rosbag.encodings import MessageReader
from mosaico_ingest.rosbag.serialization import Deserializer

_HEADER = 4
_LARGEST = 2**31 - 1
_FEW, _SMALL = 8, 4096
"""Up to this many messages and bytes in total, row-wise decoding is faster."""
_ORDERS = {">": 0, "<": 1}
"""The second byte of the encapsulation header of plain CDR."""
_ASCII_END = 0x80
_UTF8_STEPS = (0x80, 0x800, 0x10000)
"""Code points from which UTF-8 needs one more byte."""
_SURROGATES = (0xD800, 0xE000)
_UNICODE_END = 0x110000


class Decoded(Struct, frozen=True):
    """The result of decoding a message block: rows, their positions in the block, and failures."""

    rows: pa.StructArray
    """One row per decoded message. ROS messages have no nulls; in other encodings, absent values are null."""
    index: NDArray[np.int64]
    """Position of each row in the block, ascending, shape (len(rows),)."""
    failures: tuple[RowFailure, ...]
    """`row` is the position in the block; len(index) + len(failures) = len(block)."""
    padded: int = 0
    """Number of rows that end in 4 to 7 zero bytes that the definition does not explain."""
    undeclared: frozenset[str] = frozenset()
    """Fields of the messages that their schema does not declare, and that the rows do not contain."""

    def relocated(self, rows: Int64s) -> Decoded:
        """Return the result for a block of which the decoded messages are the rows `rows`."""
        failures = tuple(replace(failure, row=int(rows[failure.row])) for failure in self.failures)
        return replace(self, index=rows[self.index], failures=failures)


class Decoder(Protocol):
    """Decodes message blocks of one connection. Invalid bytes become failures, never exceptions."""

    @property
    def shape(self) -> pa.StructType:
        """The type of `Decoded.rows`."""
        ...

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        ...


class DictDecoder:
    """Decodes each message to a dictionary, and the dictionaries to Arrow."""

    def __init__(self, shape: pa.StructType, reader: MessageReader) -> None:
        self._shape = shape
        self._reader = reader

    @property
    def shape(self) -> pa.StructType:
        """The type of the rows."""
        return self._shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        return self.decode_payloads(block.payload(row) for row in range(len(block)))

    def decode_payloads(self, payloads: Iterable[bytes]) -> Decoded:
        """Decode messages that are not in a block."""
        values: list[dict[str, Any]] = []
        index: list[int] = []
        failures: list[RowFailure] = []
        for row, payload in enumerate(payloads):
            try:
                values.append(self._reader.to_dict(payload))
                index.append(row)
            except DecodeError as error:  # noqa: PERF203 - each message may fail
                failures.append(RowFailure(row, error.rule, str(error)))
        # The stubs cannot express that an array of a struct type is a StructArray.
        rows = cast("pa.StructArray", pa.array(values, type=self._shape))
        return Decoded(rows, np.array(index, np.int64), tuple(failures))


def merge_parts(parts: list[Decoded]) -> Decoded:
    """Merge the parts of one block in the order of the messages."""
    filled = [part for part in parts if len(part.index)] or parts[:1]
    failures = sorted(
        (failure for part in parts for failure in part.failures), key=lambda failure: failure.row
    )
    padded = sum(part.padded for part in parts)
    undeclared = frozenset[str]().union(*(part.undeclared for part in parts))
    if len(filled) == 1:
        return Decoded(filled[0].rows, filled[0].index, tuple(failures), padded, undeclared)
    index = np.concatenate([part.index for part in filled])
    order = np.argsort(index)
    rows = pa.concat_arrays([part.rows for part in filled])
    if bool((order[1:] < order[:-1]).any()):
        rows = rows.take(pa.Array.from_buffers(pa.int64(), len(order), [None, pa.py_buffer(order.data)]))
    return Decoded(rows, index[order], tuple(failures), padded, undeclared)


def utf8_texts(kind: pa.DataType, sizes: Int64s, data: NDArray[np.uint8]) -> tuple[Array, Int64s]:
    """Return strings of the given sizes in bytes, and the indices of strings that are not UTF-8."""
    texts = array_of(kind, len(sizes), list_offsets(sizes), data)
    if data.max(initial=0) < _ASCII_END:
        return texts, np.zeros(0, np.int64)
    try:
        texts.validate(full=True)
    except pa.ArrowInvalid:
        return texts, _not_utf8(sizes, data)
    return texts, np.zeros(0, np.int64)


def wide_texts(kind: pa.DataType, counts: Int64s, units: NDArray[np.unsignedinteger]) -> tuple[Array, Int64s]:
    """Return strings of the given counts of 32-bit units, and the indices of those with invalid or surrogate units."""
    points = units.astype("<u4")
    wrong = ((points >= _SURROGATES[0]) & (points < _SURROGATES[1])) | (points >= _UNICODE_END)
    points[wrong] = 0
    sizes = 1 + sum((points >= step).astype(np.int64) for step in _UTF8_STEPS)
    ends = list_offsets(np.asarray(sizes))
    encoded = np.frombuffer(points.tobytes().decode("utf-32-le").encode(), np.uint8)
    texts = array_of(kind, len(counts), ends[list_offsets(counts)], encoded)
    return texts, np.unique(owners_of(counts, np.flatnonzero(wrong)))


def owners_of(counts: Int64s, elements: Int64s) -> Int64s:
    """Return the owner of each element number, if owner i has the next `counts[i]` elements."""
    return np.searchsorted(np.cumsum(counts), elements, side="right")


def _not_utf8(sizes: Int64s, data: NDArray[np.uint8]) -> Int64s:
    suspects = np.unique(owners_of(sizes, np.flatnonzero(data >= _ASCII_END)))
    ends = np.cumsum(sizes)
    wrong = [
        row for row in suspects.tolist() if not _is_utf8(data[ends[row] - sizes[row] : ends[row]].tobytes())
    ]
    return np.array(wrong, np.int64)


def _is_utf8(value: bytes) -> bool:
    try:
        value.decode()
    except UnicodeDecodeError:
        return False
    return True


def build_columns(
    layout: Layout, shape: pa.StructType, payloads: Payloads, located: LocatedMessages
) -> tuple[pa.StructArray, Int64s]:
    """Return one row per located message, and the positions of the rows with invalid texts, which need `RowwiseDecoder`."""
    builder = _Builder(payloads)
    root = _Instances(layout.body.steps, located.offsets, len(located.rows))
    rows = builder.column(layout.record, shape, root, root.count)
    # The stubs cannot express that an array of a struct type is a StructArray.
    return cast("pa.StructArray", rows), builder.invalid_rows


class _Instances:
    """The m instances of a body: the messages, or the elements of a list. `owners` maps elements to messages."""

    __slots__ = ("blocks", "count", "offsets", "owners", "steps")

    def __init__(
        self, steps: tuple[Step, ...], offsets: BodyOffsets, count: int, owners: tuple[Int64s, ...] = ()
    ) -> None:
        self.steps = steps
        self.offsets = offsets
        self.count = count
        self.owners = owners
        self.blocks: dict[int, Cells] = {}
        """The bytes of each fixed-size block, gathered once for all columns in it."""

    def messages(self, instances: Int64s) -> Int64s:
        """Return the position of the message that each instance belongs to."""
        for counts in reversed(self.owners):
            instances = owners_of(counts, instances)
        return instances


class _Builder:
    """Builds the columns of one set of payloads."""

    __slots__ = ("_data", "_order", "invalid_rows")

    def __init__(self, payloads: Payloads) -> None:
        self._data = payloads.data
        self._order = payloads.order
        self.invalid_rows = np.zeros(0, np.int64)

    def column(self, column: Column, kind: pa.DataType, inst: _Instances, count: int) -> Array:
        """Return `count` values: one per instance, times the sizes of the fixed arrays around the column."""
        if not count:
            return pa.nulls(0, kind)  # type: ignore[call-overload]  # the stubs restrict it to extension types
        match column:
            case NumberColumn():
                return self._numbers(column, kind, inst)
            case TextColumn():
                return self._texts(column, kind, inst)
            case FixedArrayColumn(count=size, item=item):
                values = self.column(item, kind.field(0).type, inst, count * size)
                return array_of(kind, count, children=[values])
            case ListColumn():
                return self._items(column, kind, inst)
            case StructColumn(children=children):
                arrays = [
                    self.column(child, kind.field(number).type, inst, count)
                    for number, child in enumerate(children)
                ]
                return array_of(kind, count, children=arrays)

    def _numbers(self, column: NumberColumn, kind: pa.DataType, inst: _Instances) -> Array:
        number = np.dtype(f"{self._order}{'u1' if column.type == 'bool' else NUMBERS[column.type]}")
        view = self._block(inst, column.step).numbers(number, column.offset, column.dims)
        if column.type == "bool":
            return array_of(kind, view.size, np.packbits(view != 0, bitorder="little"))
        flags = view.flags
        if not (flags.c_contiguous and flags.aligned and number.isnative):
            view = view.astype(number.newbyteorder("="), order="C")
        return array_of(kind, view.size, view)

    def _block(self, inst: _Instances, number: int) -> Cells:
        if number not in inst.blocks:
            step = inst.steps[number]
            size = step.size if isinstance(step, FixedBlock) else 0
            inst.blocks[number] = fixed_cells(self._data, inst.offsets[number].at, size)
        return inst.blocks[number]

    def _items(self, column: ListColumn, kind: pa.DataType, inst: _Instances) -> Array:
        offsets = inst.offsets[column.step]
        if pa.types.is_binary(kind):
            data = copy_slices(self._data, offsets.at, offsets.counts)
            return array_of(kind, inst.count, list_offsets(offsets.counts), data)
        inner = self._elements(column.of, offsets, inst)
        values = self.column(column.item, kind.field(0).type, inner, inner.count)
        if pa.types.is_fixed_size_list(kind):
            return array_of(kind, inst.count, children=[values])
        return array_of(kind, inst.count, list_offsets(offsets.counts), children=[values])

    def _elements(self, of: Run | Loop, offsets: StepOffsets, inst: _Instances) -> _Instances:
        """Return the elements of a list; those of a run are instances of a body that consists of one block."""
        counts = offsets.counts
        total = int(counts.sum())
        if isinstance(of, Loop):
            return _Instances(of.body.steps, offsets.body, total, (*inst.owners, counts))
        size = of.cell.size
        if of.stride > size or not size:
            return _Instances((of.cell,), (StepOffsets(expand_ranges(offsets.at, counts, of.stride)),), total)
        inner = _Instances((of.cell,), (offsets,), total)
        inner.blocks[0] = Cells(copy_slices(self._data, offsets.at, counts * size), total, size)
        return inner

    def _texts(self, column: TextColumn, kind: pa.DataType, inst: _Instances) -> Array:
        text, offsets = column.text, inst.offsets[column.step]
        sizes = self._without_nul(inst, offsets) if text.has_nul else offsets.counts * text.unit
        data = copy_slices(self._data, offsets.at, sizes)
        if text.unit == 1:
            texts, wrong = utf8_texts(kind, sizes, data)
        else:
            texts, wrong = wide_texts(kind, offsets.counts, data.view(f"{self._order}u{text.unit}"))
        self._add_invalid(inst, wrong)
        return texts

    def _without_nul(self, inst: _Instances, offsets: StepOffsets) -> Int64s:
        """Return the sizes of texts without their terminating NUL; a text of size 0 has none."""
        sizes = np.maximum(offsets.counts - 1, 0)
        last = bytes_at(self._data, np.maximum(offsets.at + offsets.counts - 1, 0))
        open_ended = (last != 0) & (offsets.counts > 0)
        self._add_invalid(inst, np.flatnonzero(open_ended))
        return sizes

    def _add_invalid(self, inst: _Instances, wrong: Int64s) -> None:
        """Mark the messages of some instances as rows for the row-wise decoder."""
        if len(wrong):
            self.invalid_rows = np.union1d(self.invalid_rows, inst.messages(wrong))


class RowwiseDecoder:
    """Decodes each message to a dictionary, and the dictionaries to Arrow.

    Raises:
        DecodeError: The definition has no Arrow shape.
    """

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        self._deserializer = Deserializer(definition, encoding)
        self._decoder = DictDecoder(ros_shape(definition), self._deserializer)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._decoder.shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        padded = self._deserializer.padded
        decoded = self._decoder.decode(block)
        return replace(decoded, padded=self._deserializer.padded - padded)


class ColumnarDecoder:
    """Decodes by columns. Messages that it cannot decode are decoded by `RowwiseDecoder`, which is authoritative.

    Raises:
        DecodeError: The definition has no Arrow shape.
    """

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        self._definition = definition
        self._rowwise = RowwiseDecoder(definition, encoding)
        self._layout = compile_layout(definition, encoding)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._rowwise.shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block.

        Raises:
            DecodeError: A column of the block would exceed 2 GiB.
        """
        total = int(block.lengths.sum())
        if total > _LARGEST:
            return self._in_two(block, total)
        if len(block) <= _FEW and total <= _SMALL:
            return self._rowwise.decode(block)
        parts = [self._by_columns(block, order, rows) for order, rows in self._by_order(block)]
        is_remaining = np.ones(len(block), bool)
        for part in parts:
            is_remaining[part.index] = False
        if is_remaining.any() or not parts:
            parts.append(self._by_rows(block, np.flatnonzero(is_remaining)))
        return merge_parts(parts)

    def _in_two(self, block: MessageBlock, total: int) -> Decoded:
        """Decode a block too large for the 32-bit offsets of a column in two halves."""
        if len(block) == 1:
            reason = f"a message of {total} bytes; the limit is {_LARGEST} bytes"
            none = self._rowwise.decode(block.rows(slice(0)))
            return replace(none, failures=(RowFailure(0, "too-large", reason),))
        middle = int(np.searchsorted(np.cumsum(block.lengths), total // 2)) + 1
        edges = (0, min(middle, len(block) - 1), len(block))
        first, second = (self.decode(block.rows(slice(start, end))) for start, end in pairwise(edges))
        try:
            rows = pa.concat_arrays([first.rows, second.rows])
        except pa.ArrowInvalid as error:
            raise DecodeError(
                f"a column of a block of {total} bytes exceeds {_LARGEST} bytes",
                rule="batch-size",
                where=self._definition.root,
                hint="lower the memory limit, so that smaller blocks are read",
            ) from error
        index = np.concatenate([first.index, second.index + edges[1]])
        later = (replace(failure, row=failure.row + edges[1]) for failure in second.failures)
        return Decoded(rows, index, (*first.failures, *later), first.padded + second.padded)

    def _by_order(self, block: MessageBlock) -> list[tuple[str, Int64s]]:
        """Return the positions of the messages of each byte order; omit messages without a valid header."""
        if self._layout.encoding is Encoding.ROS1:
            return [("<", np.arange(len(block)))] if len(block) else []
        rows = np.flatnonzero(block.lengths >= _HEADER)
        first, second = (bytes_at(block.data, block.starts[rows] + offset) for offset in range(2))
        groups = [(order, rows[(first == 0) & (second == kind)]) for order, kind in _ORDERS.items()]
        return [(order, members) for order, members in groups if len(members)]

    def _by_columns(self, block: MessageBlock, order: str, rows: Int64s) -> Decoded:
        """Decode the valid ones of some messages of one byte order."""
        skip = _HEADER if self._layout.encoding is Encoding.CDR else 0
        starts, lengths = block.starts[rows], block.lengths[rows]
        payloads = Payloads(np.ascontiguousarray(block.data), order, starts + skip, starts + lengths)
        located = locate(self._layout, payloads)
        values, invalid = build_columns(self._layout, self.shape, payloads, located)
        if len(invalid):
            located = located.take(np.delete(np.arange(len(located.rows)), invalid))
            values, _ = build_columns(self._layout, self.shape, payloads, located)
        return Decoded(values, rows[located.rows], (), int((located.tails > PADDING).sum()))

    def _by_rows(self, block: MessageBlock, rows: Int64s) -> Decoded:
        """Decode some messages one by one."""
        return self._rowwise.decode(block.rows(rows)).relocated(rows)


def _decode_ros(definition: Definition, encoding: Encoding) -> Decoder:
    return ColumnarDecoder(definition, encoding)


def _decode_protobuf(definition: Definition, encoding: Encoding) -> Decoder:  # noqa: ARG001 - the table's signature
    from mosaico_ingest.decode.protobuf import ProtobufDecoder  # noqa: PLC0415 - ROS recordings do not need it

    return ProtobufDecoder(definition)


def _decode_json(definition: Definition, encoding: Encoding) -> Decoder:  # noqa: ARG001 - the table's signature
    from mosaico_ingest.decode.json import JsonDecoder  # noqa: PLC0415 - ROS recordings do not need it

    return JsonDecoder(definition)


DECODERS: Mapping[Encoding, Callable[[Definition, Encoding], Decoder]] = {
    Encoding.CDR: _decode_ros,
    Encoding.ROS1: _decode_ros,
    Encoding.PROTOBUF: _decode_protobuf,
    Encoding.JSON: _decode_json,
}
"""The decoder of each encoding that can be decoded."""


def decoder_for(connection: Connection) -> Decoder:
    """Return the decoder of a connection.

    Raises:
        DecodeError: There is no decoder for the encoding, or the connection has no definition with an Arrow shape.
    """
    if connection.encoding not in DECODERS:
        raise DecodeError(
            connection.problem or "there is no decoder", rule="encoding", where=connection.topic
        )
    if connection.definition is None:
        raise DecodeError(
            f"no definition of {connection.msgtype}: {connection.problem or 'the recording has none'}",
            rule="definition",
            where=connection.topic,
        )
    return _decoder(_DefinitionKey(connection.definition), connection.encoding)


class _DefinitionKey(Struct, frozen=True):
    """A definition as a cache key: equal if the root, ROS version and fields are equal.

    Schemas in other languages must be equal as text, because a JSON Schema has more than fields.
    """

    definition: Definition

    def __hash__(self) -> int:
        return hash((self.definition.root, self.definition.text))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _DefinitionKey):
            return NotImplemented
        own, others = self.definition, other.definition
        if (own.root, own.ros_version, own.types, own.shape) != (
            others.root,
            others.ros_version,
            others.types,
            others.shape,
        ):
            return False
        return own.language is Language.ROS or own.text == others.text


@lru_cache(maxsize=128)
def _decoder(key: _DefinitionKey, encoding: Encoding) -> Decoder:
    """Return a cached decoder; decoders have no state, so that several recordings can share one."""
    return DECODERS[encoding](key.definition, encoding)
