"""This file restores the messages of one topic: it finds the adapter that made the rows, and inverts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.adapters.inverse import Inverse, Restored, invert
from mosaico_ingest.adapters.mapping.columns import struct_of
from mosaico_ingest.adapters.unmodeled import UnmodeledSpec
from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.serialize import Serializer
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.export.account import TopicExport
from mosaico_ingest.store.model import TopicInfo

__all__ = ["Message", "Restorer", "restorer_for"]

_ROWS = 1000
"""Messages made at a time."""

Message = tuple[int, bytes]
"""Log time in ns, and payload."""


@dataclass(slots=True)
class Restorer:
    """Makes the messages of one topic, and counts what they lack."""

    info: TopicInfo
    definition: Definition
    adapter: str
    inverse: Inverse
    messages: int = 0
    _unknown: dict[str, None] = field(default_factory=dict[str, None])
    _kept_out: dict[str, str] = field(default_factory=dict[str, str])
    _changed: Counter[str] = field(default_factory=Counter[str])

    def read(self, batches: Iterator[pa.RecordBatch]) -> Iterator[Message]:
        """Yield the topic's messages in the order of the rows.

        Raises:
            BagError: A value has no place in the message.
        """
        encoding = Encoding.ROS1 if self.definition.ros_version == 1 else Encoding.CDR
        serializer = Serializer(self.definition, encoding)
        for batch in batches:
            for start in range(0, batch.num_rows, _ROWS):
                part = batch.slice(start, _ROWS)
                times: Any = part.column(0).to_numpy()
                rows = struct_of(part.columns[1:], self.info.ontology.struct, None, part.num_rows)
                envelope = Envelope(self.info.name, self.definition.root, times)
                restored = self.inverse.restore(rows, envelope)
                self._count(restored)
                values: Any = cast("Any", restored.rows).to_pylist()  # the stubs do not know a struct's
                yield from zip(times.tolist(), map(serializer.from_dict, values), strict=True)

    def account(self) -> TopicExport:
        """Return what became of the topic so far."""
        return TopicExport(
            topic=self.info.name,
            msgtype=self.definition.root,
            ontology=self.info.ontology.tag,
            adapter=self.adapter,
            messages=self.messages,
            unknown=tuple(self._unknown),
            not_undone=dict(self._kept_out),
            changed=dict(self._changed),
        )

    def _count(self, restored: Restored) -> None:
        self.messages += len(restored.rows)
        self._unknown.update(dict.fromkeys(restored.unknown))
        self._kept_out.update(restored.kept_out or {})
        self._changed.update(restored.changed or {})


def restorer_for(info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]) -> Restorer:
    """Return the way back for a topic, through the first adapter that makes columns like its own.

    Raises:
        AdapterError: None does, or it has no way back.
    """
    shape = ros_shape(definition)
    misfits: list[str] = []
    for spec in _candidates(info, definition, specs):
        try:
            adapter = spec.bind(definition, shape)
        except AdapterError as error:
            misfits.append(error.what)
            continue
        if _makes(adapter, info):
            inverse = invert(adapter, shape, info.metadata)
            return Restorer(info, definition, spec.name, inverse)
    raise AdapterError(
        f"no adapter known makes {info.ontology.tag} of {definition.root}",
        hint=misfits[0] if misfits else "name the one that did with --adapter",
    )


def _candidates(
    info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]
) -> Iterator[AdapterSpec]:
    """Yield the adapters that may have made a topic: those named, the default one, the others of the catalog."""
    yield from (spec for spec in specs if not spec.ros_types or definition.root in spec.ros_types)
    yield ROSBridge().resolve(info.name, definition.root).spec
    yield from (spec for spec in BUILTIN if definition.root in spec.ros_types)
    yield UnmodeledSpec(serialization_format=info.ontology.serialization_format)


def _makes(adapter: Adapter, info: TopicInfo) -> bool:
    made = adapter.ontology
    return (made.tag, made.struct) == (info.ontology.tag, info.ontology.struct)
