"""Inverted adapters: stored rows and the adapter that produced them in, rows in the shape of the ROS type out.

Each result is verified: the restored messages are adapted again, and rows that differ from the stored ones are counted.
The package must not depend on the store or on the writers of containers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapter, Envelope, UnmodeledAdapter, without_files
from mosaico_ingest.adapters.inverse.columns import ColumnInverter
from mosaico_ingest.adapters.inverse.message_builder import FieldPath, MessageBuilder, Presence
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    DataType,
    Mask,
    arrays,
    field_of,
    fixed_list,
    is_list,
    null_mask,
    open_list,
    pc,
    pt,
    struct_of,
    variable_list,
)
from mosaico_ingest.adapters.mapping.expressions import FieldAccess, MessageRef, TypedExpression
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, ReadPath, column_reads, unread_paths
from mosaico_ingest.adapters.python import PythonAdapter
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Language, MessageType
from mosaico_ingest.rosbag.definitions.rosbags_types import message_values, typestore_of


def differences(left: Array, right: Array) -> Mapping[str, Mask]:
    """Return where the fields of two columns of one struct differ, for the fields that differ at all."""
    pairs = ((f.name, ~_same(field_of(left, f.name), field_of(right, f.name))) for f in left.type)
    return {name: wrong for name, wrong in pairs if wrong.any()}


def _same(left: Array, right: Array) -> Mask:
    absent = np.asarray(left.is_null()), np.asarray(right.is_null())
    equal = absent[0] == absent[1]
    present = np.flatnonzero(~absent[0] & ~absent[1])
    if len(present) < len(left):
        at = arrays.array(present)
        left, right = left.take(at), right.take(at)
    equal[present] = _same_values(left, right)
    return equal


def _same_values(left: Array, right: Array) -> Mask:
    """Compare values without nulls."""
    if pt.is_struct(left.type):
        equal = np.ones(len(left), bool)
        for field in left.type:
            equal &= _same(field_of(left, field.name), field_of(right, field.name))
        return equal
    if is_list(left.type):
        return _same_lists(left, right)
    equal = np.asarray(pc.equal(left, right))
    if pt.is_floating(left.type):
        equal |= np.asarray(pc.and_(pc.is_nan(left), pc.is_nan(right)))
    return equal


def _same_lists(left: Array, right: Array) -> Mask:
    lengths = [open_list(side)[1].lengths for side in (left, right)]
    equal = lengths[0] == lengths[1]
    rows = np.flatnonzero(equal)
    if len(rows) < len(left):
        at = arrays.array(rows)
        left, right = left.take(at), right.take(at)
    values, axis = open_list(left)
    wrong = axis.parents[~_same(values, open_list(right)[0])]
    equal[rows[wrong]] = False
    return equal


_IMAGE = "Image"
"""The one type whose rows `topic_settings` may have packed."""


class Restored(Struct, frozen=True):
    """A batch of restored messages, and how they differ from the original ones."""

    rows: pa.StructArray
    """The messages in the ROS shape; null for absent fields, which ROS messages do not have."""
    defaulted: tuple[str, ...] = ()
    """Fields that are not stored; they are absent, or zero, empty or false where messages cannot lack them."""
    not_invertible: Mapping[str, str] | None = None
    """Columns that cannot be inverted, with their expressions."""
    changed: Mapping[str, int] | None = None
    """Columns that differ if the messages are ingested again, with the number of rows."""


class Inverse(Protocol):
    """Restores the messages of one topic."""

    def restore(self, rows: pa.StructArray, envelope: Envelope) -> Restored:
        """Return one message per row."""
        ...


def invert(adapter: Adapter, definition: Definition, metadata: Mapping[str, Any]) -> Inverse:
    """Return the inverse of an adapter that is bound to a definition; `metadata` is the topic's.

    Raises:
        AdapterError: The adapter is written in Python and does not override `to_ros`, or the messages are not from ROS.
        BagError: The message objects of an adapter in Python cannot be created.
    """
    shape = ros_shape(definition)
    if isinstance(adapter, UnmodeledAdapter):
        return _UnmodeledInverse(shape, definition.language is not Language.ROS)
    if isinstance(adapter, MappingAdapter):
        if adapter.inverse_problem is not None:
            raise AdapterError(adapter.inverse_problem)
        texts = _metadata_texts(adapter.metadata, metadata)
        return _MappingInverse(adapter, shape, texts, _presence_of(adapter, definition))
    if isinstance(adapter, PythonAdapter) and adapter.is_invertible:
        if definition.language is not Language.ROS:
            raise AdapterError(f"to_ros of {adapter.adapter.__name__} applies to ROS messages only")
        return _PythonInverse(adapter, definition.root, shape, typestore_of(definition))
    raise AdapterError("its adapter is written in Python", hint="override to_ros in the adapter")


class _UnmodeledInverse(Struct, frozen=True):
    """The exact inverse for messages stored in their ROS shape."""

    shape: pa.StructType
    nullable: bool

    def restore(self, rows: pa.StructArray, envelope: Envelope) -> Restored:  # noqa: ARG002 - the protocol's signature
        columns = [
            _in_shape(values, field.type, nullable=self.nullable)
            for values, field in zip(rows.flatten(), self.shape, strict=True)
        ]
        return Restored(struct_of(columns, self.shape, None, len(rows)))


class _MappingInverse(Struct, frozen=True):
    """The inverse for messages that a mapping adapted."""

    adapter: MappingAdapter
    shape: pa.StructType
    metadata_texts: Mapping[FieldPath, str]
    presence: Presence | None

    def restore(self, rows: pa.StructArray, envelope: Envelope) -> Restored:
        if self.adapter.ontology.tag == _IMAGE:
            rows = without_files(rows)
        builder = MessageBuilder(self.shape, len(rows), self.presence)
        undo = ColumnInverter(builder, self.metadata_texts)
        undo.record(self.adapter.record, rows)
        messages = builder.build()
        counts = _changed(self.adapter, rows, messages, replace(envelope, msgtype=self.adapter.msgtype))
        return Restored(messages, tuple(builder.defaulted), undo.not_invertible, counts)


class _PythonInverse(Struct, frozen=True):
    """The inverse for messages that an adapter in Python converted: its `to_ros`, message by message."""

    adapter: PythonAdapter
    msgtype: str
    shape: pa.StructType
    typestore: Any
    """A typestore of rosbags; its type is not named here because only `rosbag` imports the library."""

    def restore(self, rows: pa.StructArray, envelope: Envelope) -> Restored:
        struct_rows: Any = rows  # the stubs lack to_pylist of struct arrays
        times: list[int] = envelope.log_times.tolist()
        messages = [
            self._message(row, time) for row, time in zip(struct_rows.to_pylist(), times, strict=True)
        ]
        try:
            # The stubs do not derive the array class from the type.
            restored = cast("pa.StructArray", arrays.array(messages, self.shape))
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise AdapterError(f"a value that {self._method} returns does not fit: {error}") from error
        return Restored(restored, changed=_changed(self.adapter, rows, restored, envelope))

    def _message(self, row: dict[str, Any], time: int) -> dict[str, Any]:
        try:
            message = self.adapter.to_ros(row, time, self.typestore, self.msgtype)
            return message_values(message, self.shape)
        except Exception as error:  # user code may raise anything
            raise AdapterError(
                f"{self._method} failed at {time} ns: {type(error).__name__}: {error}"
            ) from error

    @property
    def _method(self) -> str:
        return f"{self.adapter.adapter.__name__}.to_ros"


def _changed(adapter: Adapter, rows: Array, messages: Array, envelope: Envelope) -> Mapping[str, int]:
    """Return the columns that differ after the messages are adapted again, with the number of rows."""
    adapted = adapter.adapt(messages, envelope)
    stored_rows = rows if len(adapted.index) == len(rows) else rows.take(arrays.array(adapted.index))
    counts_by_column = {
        name: int(wrong.sum()) for name, wrong in differences(stored_rows, adapted.rows).items()
    }
    dropped = sum(len(positions) for positions in adapted.dropped.values())
    counts = {"(refused)": len(adapted.failures), "(dropped)": dropped}
    return counts_by_column | {name: count for name, count in counts.items() if count}


def _presence_of(adapter: MappingAdapter, definition: Definition) -> Presence | None:
    """Return which fields can be absent, and are if no column reads them; None for messages of ROS."""
    if definition.language is Language.ROS:
        return None
    required = frozenset(_required_fields(definition, definition.message, ()))
    unread = unread_paths(ros_shape(definition), set(column_reads(adapter)))
    return Presence(required, frozenset(unread) - required)


def _required_fields(definition: Definition, message: MessageType, at: ReadPath) -> Iterator[ReadPath]:
    for field in message.fields:
        path = (*at, field.name)
        if field.is_required:
            yield path
        if field.is_message:
            yield from _required_fields(definition, definition.types[field.type], path)


def _metadata_texts(
    values: Mapping[str, TypedExpression], metadata: Mapping[str, Any]
) -> Mapping[FieldPath, str]:
    """Return the fields of the first message that the topic metadata contains."""
    texts: dict[FieldPath, str] = {}
    for key, typed in values.items():
        if (
            isinstance(typed, FieldAccess)
            and isinstance(typed.operand, MessageRef)
            and isinstance(metadata.get(key), str)
        ):
            texts[(typed.name,)] = metadata[key]
    return texts


def _in_shape(values: Array, kind: DataType, *, nullable: bool) -> Array:
    """Cast values to the message's own type, and drop the placeholder fields of empty messages."""
    absent = null_mask(values) if nullable else None
    if values.type == kind and not values.null_count:
        return values
    if pt.is_struct(kind):
        names = [field.name for field in values.type]
        children = [
            _in_shape(field_of(values, f.name), f.type, nullable=nullable) for f in kind if f.name in names
        ]
        return struct_of(children, kind, absent, len(values))
    if is_list(kind):
        elements, axis = open_list(values)
        elements = _in_shape(elements, kind.value_type, nullable=nullable)
        if pt.is_fixed_size_list(kind):
            return fixed_list(elements, kind.list_size, absent, len(values), kind)
        return variable_list(elements, axis.offsets, absent, kind)
    if not nullable and null_mask(values) is not None:
        raise AdapterError(f"null where a {kind} is needed; the topic was not written by an ingestion")
    return values.cast(kind)
