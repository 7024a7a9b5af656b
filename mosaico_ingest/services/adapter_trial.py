"""A trial of an adapter: the rows that it makes of the first messages of a topic."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapted, Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.bridge import outputs_of
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.decode.decoder import decoder_for
from mosaico_ingest.errors import AdapterError, BagError, NothingMatched
from mosaico_ingest.rosbag.blocks import Connection, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Resolver
from mosaico_ingest.rosbag.recording import open_recording
from mosaico_ingest.services.adapters import topic_connections

_ROWS = 64


class TriedMessage(Struct, frozen=True):
    """A message, and the rows or the rejection that an adapter derives from it."""

    index: int
    """Position in the topic, from 0."""
    log_time_ns: int
    message: dict[str, Any]
    """The fields of the message; empty if it cannot be decoded."""
    rows: dict[str, list[dict[str, Any]]]
    """The rows by output; the output of an adapter without `outputs` has an empty name."""
    rejected: str | None = None
    """The rule and the reason for the rejection of the message."""
    dropped: str | None = None
    """The rule that drops the message."""


def try_adapter(
    spec: AdapterSpec,
    bag: Path,
    topic: str,
    count: int,
    *,
    resolve: Resolver,
    parameters: dict[str, Scalar] | None = None,
) -> tuple[TriedMessage, ...]:
    """Convert the first messages of a topic; no message is stored.

    Raises:
        BagError: The recording cannot be opened, or the definition of the topic is not known.
        NothingMatched: There is no such topic, or it has no messages.
        AdapterError: The adapter does not fit the type of the topic, or has no such parameter.
    """
    if parameters:
        if not isinstance(spec, MappingSpec):
            raise AdapterError(f"{spec.name} has no parameters", hint="remove --with")
        spec = spec.with_parameters(parameters)
    tried: list[TriedMessage] = []
    with open_recording(bag, resolve=resolve) as recording:
        connections = {one.id: one for one in topic_connections(recording, topic)}
        adapters = {key: _bound(spec, one) for key, one in connections.items()}
        names = [output.output for output in outputs_of(spec)] or [""]
        for block in recording.message_blocks(list(connections), max_rows=_ROWS):
            part = block.rows(slice(0, count - len(tried)))
            connection = connections[block.connection]
            tried += _tried(part, connection, adapters[block.connection], names, first=len(tried))
            if len(tried) == count:
                break
    if not tried:
        raise NothingMatched("the topic has no messages", where=topic, hint="name another topic")
    return tuple(tried)


def _bound(spec: AdapterSpec, connection: Connection) -> Adapter:
    if connection.definition is None:
        raise BagError(
            connection.problem or f"no definition of {connection.msgtype} is known", where=connection.topic
        )
    return spec.bind(connection.definition, ros_shape(connection.definition))


def _tried(
    block: MessageBlock, connection: Connection, adapter: Adapter, names: list[str], *, first: int
) -> list[TriedMessage]:
    decoded = decoder_for(connection).decode(block)
    envelope = Envelope(
        connection.topic, connection.msgtype, block.log_times, block.publish_times, block.sequences
    ).take(decoded.index)
    adapted = adapter.adapt(decoded.rows, envelope)
    values = cast("Any", decoded.rows).to_pylist()  # the stubs lack to_pylist of struct arrays
    messages = dict(zip(decoded.index.tolist(), values, strict=True))
    rejected = {failure.row: f"[{failure.rule}] {failure.reason}" for failure in decoded.failures}
    rejected |= {
        int(decoded.index[failure.row]): f"[{failure.rule}] {failure.reason}" for failure in adapted.failures
    }
    dropped = {
        int(decoded.index[row]): rule for rule, rows in adapted.dropped.items() for row in rows.tolist()
    }
    rows = {
        name: _rows_of(output, decoded.index)
        for name, output in zip(names, (adapted, *adapted.others), strict=False)
    }
    return [
        TriedMessage(
            first + at,
            int(block.log_times[at]),
            messages.get(at, {}),
            {name: of_output.get(at, []) for name, of_output in rows.items()},
            rejected.get(at),
            dropped.get(at),
        )
        for at in range(len(block))
    ]


def _rows_of(adapted: Adapted, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> dict[int, list[Any]]:
    """Return the rows of each message that has any, by the position of the message in the block."""
    rows: dict[int, list[Any]] = {}
    values: Any = adapted.rows  # the stubs lack to_pylist of struct arrays
    for message, row in zip(index[adapted.index].tolist(), values.to_pylist(), strict=True):
        rows.setdefault(message, []).append(row)
    return rows
