"""The columnar decoder of protobuf messages.

Google's parser checks every message, and ptars builds the columns of the valid ones. ptars receives a copy of the
descriptor in which each construct that it treats in its own way has an equivalent with the same bytes:

* Well-known types get other names, because ptars converts those of `google.protobuf` to types with a smaller range.
* Enums are int32, so that unknown numbers are kept. Maps are lists of entries, so that their order is kept.
* Messages that become JSON text are bytes, which `json_text` converts afterwards.

`ProtobufCodec` decodes blocks with messages that have two members of one `oneof`, a map with a duplicate key, a map entry
without its message, or an unknown number of a proto2 enum, which are rare, and types with groups, which ptars does not
support.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import DecodeError as WireError
from msgspec import Struct
from numpy.typing import NDArray
from ptars import HandlerPool

from mosaico_ingest.decode.decoder import Decoded, DictDecoder
from mosaico_ingest.decode.layout import Array, array_of, copy_slices, list_offsets
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.encodings.protobuf import (
    Form,
    ProtobufCodec,
    descriptor_of,
    form_of,
    json_text,
    message_class,
    message_type,
    requires_fields,
)

_FEW = 4
"""Up to this many messages, row-wise decoding is faster."""


class ProtobufDecoder:
    """Decodes protobuf messages by columns; `ProtobufCodec` decodes the messages that ptars cannot decode."""

    def __init__(self, definition: Definition) -> None:
        self._shape = ros_shape(definition)
        self._rowwise = DictDecoder(self._shape, ProtobufCodec(definition))
        self._class = message_class(definition)
        descriptor = descriptor_of(definition)
        self._columns = None if _has_groups(descriptor) else _Columns(descriptor)
        self._is_checked = requires_fields(descriptor)

    @property
    def shape(self) -> pa.StructType:
        """The type of the rows."""
        return self._shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        if self._columns is None or len(block) <= _FEW:
            return self._rowwise.decode(block)
        payloads = _binary_array(block)
        valid = self._valid_rows(payloads)
        if valid is None:
            rows = self._columns.build(payloads, self._shape)
            if rows is not None:
                return Decoded(rows, np.arange(len(block), dtype=np.int64), ())
            return self._rowwise.decode(block)
        return self._with_invalid(block, payloads, valid)

    def _with_invalid(self, block: MessageBlock, payloads: Array, valid: NDArray[np.bool_]) -> Decoded:
        """Decode the valid messages by columns, and report the others."""
        index = np.flatnonzero(valid).astype(np.int64)
        others = np.flatnonzero(~valid)
        rejected = self._rowwise.decode(block.rows(others)).relocated(others)
        rows = None
        if self._columns is not None and not len(rejected.index):
            rows = self._columns.build(payloads.filter(pa.array(valid)), self._shape)
        if rows is None:
            return self._rowwise.decode(block)
        return Decoded(rows, index, rejected.failures)

    def _valid_rows(self, payloads: Any) -> NDArray[np.bool_] | None:  # noqa: ANN401 - a binary array
        """Return which messages Google's parser accepts, or None if it accepts all."""
        parse = self._class.FromString
        messages = payloads.to_pylist()
        if not self._is_checked:
            try:
                deque(map(parse, messages), maxlen=0)
            except WireError:
                pass
            else:
                return None
        valid = np.fromiter((_is_valid(parse, payload) for payload in messages), np.bool_, len(messages))
        return None if valid.all() else valid


def _is_valid(parse: Callable[[bytes], Any], payload: bytes) -> bool:
    try:
        return parse(payload).IsInitialized()
    except WireError:
        return False


def _binary_array(block: MessageBlock) -> Any:  # noqa: ANN401 - a binary array
    """Return the payloads as an array; adjacent payloads are not copied."""
    data = copy_slices(block.data, block.starts, block.lengths)
    return array_of(pa.binary(), len(block), list_offsets(block.lengths), data)


def _has_groups(descriptor: Descriptor) -> bool:
    return any(field.type == FieldDescriptor.TYPE_GROUP for field in _fields(descriptor, set()))


def _fields(descriptor: Descriptor, visited: set[str]) -> Iterator[FieldDescriptor]:
    """Yield the fields of a message and of all messages that its columns contain."""
    if descriptor.full_name in visited:
        return
    visited.add(descriptor.full_name)
    for field in descriptor.fields:
        yield field
        if form_of(field) is Form.MESSAGE:
            yield from _fields(message_type(field), visited)


class _Columns:
    """Builds the columns of valid messages with ptars."""

    def __init__(self, descriptor: Descriptor) -> None:
        file = FileDescriptorProto(name="columns.proto", syntax="proto3")
        names: dict[str, str] = {}
        _add_message(file, descriptor, names)
        pool = descriptor_pool.DescriptorPool()
        pool.Add(file)
        root = pool.FindMessageTypeByName(names[descriptor.full_name])
        self._handler = HandlerPool([root.file]).get_for_message(root)
        self._struct = _StructPlan.of(descriptor)

    def build(self, payloads: Any, shape: pa.StructType) -> pa.StructArray | None:  # noqa: ANN401 - a binary array
        """Return one row per message; None if a message needs `ProtobufCodec`."""
        try:
            batch = self._handler.array_to_record_batch(payloads)
            rows = self._struct.build(batch.to_struct_array(), shape)
        except (ValueError, _NeedsCodec):
            return None
        return cast("pa.StructArray", rows)


class _NeedsCodec(Exception):  # noqa: N818 - control flow inside this module
    """A message is the result of a merge that ptars does not perform."""


def _add_message(file: FileDescriptorProto, descriptor: Descriptor, names: dict[str, str]) -> str:
    """Add an equivalent of a message and return its name."""
    if descriptor.full_name in names:
        return names[descriptor.full_name]
    name = names[descriptor.full_name] = f"M{len(names)}"
    position = len(file.message_type)
    file.message_type.add(name=name)
    fields = [_equivalent(file, field, names) for field in descriptor.fields]
    message = file.message_type[position]
    oneofs: dict[str, int] = {}
    for field, copy in zip(descriptor.fields, fields, strict=True):
        oneof = field.containing_oneof
        if oneof is not None and not _is_synthetic(oneof):
            if oneof.name not in oneofs:
                oneofs[oneof.name] = len(message.oneof_decl)
                message.oneof_decl.add(name=oneof.name)
            copy.oneof_index = oneofs[oneof.name]
        message.field.append(copy)
    for copy, field in zip(message.field, descriptor.fields, strict=True):
        is_optional = field.has_presence and not copy.HasField("oneof_index")
        if is_optional and copy.type != FieldDescriptorProto.TYPE_MESSAGE:
            copy.proto3_optional = True
            copy.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{field.name}_{field.number}")
    return name


def _is_synthetic(oneof: Any) -> bool:  # noqa: ANN401 - a OneofDescriptor
    """Return whether a `oneof` only represents the presence of an optional field."""
    return len(oneof.fields) == 1 and oneof.name == f"_{oneof.fields[0].name}"


def _equivalent(
    file: FileDescriptorProto, field: FieldDescriptor, names: dict[str, str]
) -> FieldDescriptorProto:
    """Return a field with the same bytes; see the module's description."""
    repeated = (
        FieldDescriptorProto.LABEL_REPEATED if field.is_repeated else FieldDescriptorProto.LABEL_OPTIONAL
    )
    copy = FieldDescriptorProto(name=field.name, number=field.number, label=repeated)
    form = form_of(field)
    if form is Form.JSON:
        copy.type = FieldDescriptorProto.TYPE_BYTES
    elif form is Form.SCALAR:
        is_enum = field.type == FieldDescriptor.TYPE_ENUM
        # The stubs give the constants of both classes different types.
        kind: Any = FieldDescriptorProto.TYPE_INT32 if is_enum else field.type
        copy.type = kind
    else:
        copy.type = FieldDescriptorProto.TYPE_MESSAGE
        copy.type_name = f".{_add_message(file, message_type(field), names)}"
    return copy


class _FieldPlan(Struct, frozen=True):
    """The conversion of one column of ptars to a column of the shape."""

    form: Form
    is_repeated: bool
    is_map: bool
    parse: Callable[[bytes], Any] | None
    """Parses the bytes of a message that becomes JSON text."""
    struct: _StructPlan | None
    numbers: Any
    """An array of the numbers of a closed enum, whose other numbers count as absent; None for other types."""

    @classmethod
    def of(cls, field: FieldDescriptor) -> _FieldPlan:
        form = form_of(field)
        parse = message_factory.GetMessageClass(message_type(field)).FromString if form is Form.JSON else None
        is_map = form is Form.MESSAGE and message_type(field).GetOptions().map_entry
        struct = _StructPlan.of(message_type(field)) if form is Form.MESSAGE else None
        enum = field.enum_type
        numbers = None
        if enum is not None and enum.is_closed:
            numbers = pa.array([value.number for value in enum.values], pa.int32())
        return cls(form, field.is_repeated, is_map, parse, struct, numbers)

    def build(self, column: Any, kind: Any) -> Array:  # noqa: ANN401 - an array and its type
        """Return the column in its type, without copying values."""
        if not self.is_repeated:
            return self._values(column, kind)
        values = self._values(column.values, kind.value_type)
        if self.is_map:
            _refuse_irregular_entries(column, values)
        # ptars never builds slices, so the list's own offsets apply to the new values.
        return pa.Array.from_buffers(kind, len(column), column.buffers()[:2], children=[values])

    def _values(self, column: Any, kind: Any) -> Array:  # noqa: ANN401 - an array and its type
        if self.form is Form.JSON:
            return _json_texts(column, self.parse)
        if self.form is Form.WRAPPER:
            return pc.struct_field(column, [0])
        if self.struct is not None:
            return self.struct.build(column, kind)
        if self.numbers is not None and not pc.all(pc.is_in(column.drop_null(), self.numbers)).as_py():
            raise _NeedsCodec
        return column


class _StructPlan(Struct, frozen=True):
    """The conversion of one struct of ptars."""

    fields: tuple[_FieldPlan, ...]
    positions: tuple[int, ...]
    """The position of each field in the struct of ptars, which sorts fields by number."""
    oneofs: tuple[tuple[int, ...], ...]
    """The positions of the members of each `oneof` in the struct of ptars."""

    @classmethod
    def of(cls, descriptor: Descriptor) -> _StructPlan:
        order = sorted(range(len(descriptor.fields)), key=lambda number: descriptor.fields[number].number)
        position = {descriptor.fields[number].name: at for at, number in enumerate(order)}
        oneofs = [oneof for oneof in descriptor.oneofs if len(oneof.fields) > 1]
        return cls(
            tuple(_FieldPlan.of(field) for field in descriptor.fields),
            tuple(position[field.name] for field in descriptor.fields),
            tuple(tuple(position[field.name] for field in oneof.fields) for oneof in oneofs),
        )

    def build(self, rows: Any, shape: Any) -> Array:  # noqa: ANN401 - a struct array and its type
        """Return the struct in its type."""
        columns = [rows.field(position) for position in range(rows.type.num_fields)]
        for members in self.oneofs:
            _refuse_two_members([columns[position] for position in members], len(rows))
        children = [
            plan.build(columns[position], field.type)
            for plan, position, field in zip(self.fields, self.positions, shape, strict=True)
        ]
        return pa.Array.from_buffers(shape, len(rows), rows.buffers()[:1], children=children)


def _refuse_two_members(members: Sequence[Any], count: int) -> None:
    """Raise if a message has two members of one `oneof`, of which only the last one is valid."""
    if sum(count - column.null_count for column in members) <= 1:
        return
    present = sum(np.asarray(column.is_valid()).astype(np.int64) for column in members)
    if bool((np.asarray(present) > 1).any()):
        raise _NeedsCodec


def _refuse_irregular_entries(column: Any, entries: Any) -> None:  # noqa: ANN401 - a list array and its values
    """Raise if a map contains a key twice, of which only the last one is valid, or an entry without its message."""
    if not len(entries):
        return
    if entries.field(1).null_count:
        raise _NeedsCodec
    counts = np.diff(np.asarray(column.offsets)).astype(np.int64)
    owners = np.repeat(np.arange(len(column)), counts)
    keys = pa.table({"owner": pa.array(owners), "key": entries.field(0)})
    if keys.group_by(["owner", "key"]).aggregate([]).num_rows < len(entries):
        raise _NeedsCodec


def _json_texts(column: Any, parse: Callable[[bytes], Any] | None) -> Array:  # noqa: ANN401 - a binary array
    if parse is None:
        return column
    texts = [None if data is None else json_text(parse(data)) for data in column.to_pylist()]
    return pa.array(texts, pa.string())
