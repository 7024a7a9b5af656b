"""The columnar decoder of JSON messages.

msgspec confirms that messages are valid (see `json_schema.confirming_type`), and pyarrow builds the columns of the
confirmed ones. `JsonCodec`, which asks jsonschema, decodes all other messages.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import msgspec
import numpy as np
import pyarrow as pa
from msgspec.structs import replace
from numpy.typing import NDArray
from pyarrow.json import ParseOptions, ReadOptions, read_json

from mosaico_ingest.decode.decoder import Decoded, DictDecoder, merge_parts
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec
from mosaico_ingest.rosbag.encodings.json_schema import JsonType, confirming_type

_FEW = 4
"""Up to this many messages, row-wise decoding is faster."""


class JsonDecoder:
    """Decodes JSON messages by columns; `JsonCodec` decodes the messages that msgspec or pyarrow reject."""

    def __init__(self, definition: Definition) -> None:
        self._shape = ros_shape(definition)
        has_schema = bool(definition.text.strip())
        kind = confirming_type(definition.text, definition.root) if has_schema else dict
        self._confirm = None if kind is None else msgspec.json.Decoder(kind)
        self._codec = JsonCodec(definition)
        self._columns = self._codec.columns
        has_parser = bool(self._columns.fields) and not self._columns.contains("json")
        self._schema = _parsed_schema(self._columns) if has_parser else None
        """The types that pyarrow parses; None without columns, or if a column is JSON text, which pyarrow cannot produce."""

    @property
    def shape(self) -> pa.StructType:
        """The type of the rows."""
        return self._shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        payloads = [block.payload(row) for row in range(len(block))]
        confirmed = self._confirmed(payloads)
        if confirmed.all():
            decoded = self._by_columns(payloads)
            return self._by_rows(block) if decoded is None else decoded
        index = np.flatnonzero(confirmed).astype(np.int64)
        parts = [self._by_rows(block.rows(~confirmed)).relocated(np.flatnonzero(~confirmed))]
        if len(index):
            decoded = self._by_columns([payloads[row] for row in index])
            if decoded is None:
                decoded = self._by_rows(block.rows(index))
            parts.append(decoded.relocated(index))
        return merge_parts(parts)

    def _by_rows(self, block: MessageBlock) -> Decoded:
        return self._with_reader(self._codec.read, (block.payload(row) for row in range(len(block))))

    def _with_reader(self, read: _Read, payloads: Iterable[bytes]) -> Decoded:
        reader = _Reader(read, set())
        decoded = DictDecoder(self._shape, reader).decode_payloads(payloads)
        return replace(decoded, undeclared=frozenset(reader.undeclared))

    def _confirmed(self, payloads: list[bytes]) -> NDArray[np.bool_]:
        """Return which messages are certainly valid JSON objects that satisfy the schema."""
        if self._confirm is None or len(payloads) <= _FEW:
            return np.zeros(len(payloads), bool)
        if not any(b"\n" in payload for payload in payloads):
            try:
                decoded = self._confirm.decode_lines(b"\n".join(payloads))
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                pass
            else:
                if len(decoded) == len(payloads):  # empty lines are skipped
                    return np.ones(len(payloads), bool)
        return np.fromiter(map(self._is_confirmed, payloads), np.bool_, len(payloads))

    def _is_confirmed(self, payload: bytes) -> bool:
        if self._confirm is None:
            return False
        try:
            self._confirm.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return False
        return True

    def _by_columns(self, payloads: list[bytes]) -> Decoded | None:
        """Decode confirmed messages; None if a value fits no column, or a field occurs twice in an object."""
        if self._schema is None:
            return self._by_values(payloads)
        # A line break in a valid message is white space.
        lines = b"\n".join(payload.replace(b"\n", b" ") for payload in payloads)
        options = ParseOptions(explicit_schema=self._schema, unexpected_field_behavior="infer")
        undeclared: set[str] = set()
        try:
            table = read_json(
                io.BytesIO(lines), ReadOptions(use_threads=False, block_size=len(lines) + 1), options
            )
            if table.num_rows != len(payloads):
                return None
            # pyarrow builds invalid arrays of lists of nulls in fields without a column.
            rows = table.combine_chunks().to_struct_array().combine_chunks()
            shaped = _shaped(rows, self._columns, self._shape, "$", undeclared)
        except (pa.ArrowException, ValueError):
            return None
        index = np.arange(len(payloads), dtype=np.int64)
        return Decoded(shaped, index, (), undeclared=frozenset(undeclared))

    def _by_values(self, payloads: list[bytes]) -> Decoded:
        """Decode confirmed messages to Python objects, and these to columns."""
        return self._with_reader(self._read_confirmed, payloads)

    def _read_confirmed(self, payload: bytes, undeclared: set[str]) -> dict[str, Any]:
        return self._columns.to_column(msgspec.json.decode(payload), "$", undeclared)


_Read: TypeAlias = Callable[[bytes, set[str]], "dict[str, Any]"]
"""Returns the fields of a message, and adds the fields without a column to a set."""


class _Reader(msgspec.Struct, frozen=True):
    """A `MessageReader` that collects the fields without a column; one per block, because decoders have no state."""

    read: _Read
    undeclared: set[str]

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        return self.read(payload, self.undeclared)


def _parsed_schema(columns: JsonType) -> pa.Schema:
    return pa.schema([pa.field(name, _parsed_type(field)) for name, field in columns.fields])


def _parsed_type(kind: JsonType) -> pa.DataType:
    """Return the type of the JSON values of a column: base64 is text."""
    if kind.kind == "struct":
        return pa.struct([pa.field(name, _parsed_type(field)) for name, field in kind.fields])
    if kind.item is not None:
        return pa.list_(_parsed_type(kind.item))
    return pa.string() if kind.kind == "binary" else kind.arrow


def _shaped(values: Any, kind: JsonType, shape: Any, path: str, undeclared: set[str]) -> Any:  # noqa: ANN401 - arrays and types
    """Return a column in its type; add the fields that it lacks to `undeclared`."""
    if kind.kind == "struct":
        names = dict(kind.fields)
        undeclared |= {f"{path}.{field.name}"[2:] for field in values.type if field.name not in names}
        children = [
            _shaped(
                values.field(values.type.get_field_index(name)),
                inner,
                field.type,
                f"{path}.{name}",
                undeclared,
            )
            for (name, inner), field in zip(kind.fields, shape, strict=True)
        ]
        mask = values.is_null() if values.null_count else None
        return pa.StructArray.from_arrays(children, fields=list(shape), mask=mask)
    if kind.item is not None:
        items = _shaped(values.values, kind.item, shape.value_type, f"{path}[]", undeclared)
        mask = values.is_null() if values.null_count else None
        return pa.ListArray.from_arrays(values.offsets, items, type=shape, mask=mask)
    return _from_base64(values) if kind.kind == "binary" else values


def _from_base64(values: Any) -> Any:  # noqa: ANN401 - a string array
    """Return the bytes of base64 texts; raise ValueError if a text is not base64."""
    from base64 import b64decode  # noqa: PLC0415 - only binary columns need it

    return pa.array(
        [None if text is None else b64decode(text, validate=True) for text in values.to_pylist()], pa.binary()
    )
