"""This file reads one message of a recording as a row, for the tests and drafts of adapters."""

from __future__ import annotations

from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.batch import Channel, RawBatch
from mosaico_ingest.bag.definition import Definition, Resolver
from mosaico_ingest.bag.recording import Recording, open_recording
from mosaico_ingest.decode.choose import decoder_for
from mosaico_ingest.errors import BagError, DecodeError, NothingMatched

__all__ = ["definition_in", "message_in"]

_ROWS = 64


def definition_in(path: Path, msgtype: str, *, resolve: Resolver) -> Definition:
    """Return a type's definition as a recording has it.

    Raises:
        BagError: The recording cannot be opened, or its definition of the type is not known.
        NothingMatched: No topic has that type.
    """
    with open_recording(path, resolve=resolve) as recording:
        return _definition(_channels(recording, msgtype=msgtype)[0])


def message_in(
    path: Path, topic: str, index: int = 0, *, resolve: Resolver
) -> tuple[Definition, pa.StructArray]:
    """Return the definition of a topic's message, and the message as the only row in its ROS shape.

    Raises:
        BagError: The recording cannot be opened, has fewer messages, or the message cannot be decoded.
        NothingMatched: There is no such topic.
    """
    with open_recording(path, resolve=resolve) as recording:
        channels = _channels(recording, topic=topic)
        before = 0
        for batch in recording.batches([channel.id for channel in channels], rows=_ROWS):
            if index < before + len(batch):
                return _definition(batch.channel), _row(batch, index - before)
            before += len(batch)
    raise BagError(
        f"{topic} has {before} messages, there is none at index {index}",
        where=str(path),
        hint="the first is at index 0",
    )


def _channels(recording: Recording, *, topic: str | None = None, msgtype: str | None = None) -> list[Channel]:
    found = [
        one for one in recording.channels if topic in {None, one.topic} and msgtype in {None, one.msgtype}
    ]
    if found:
        return found
    wanted = topic or msgtype or ""
    known = sorted({one.topic if topic else one.msgtype for one in recording.channels})
    near = get_close_matches(wanted, known, n=1)
    raise NothingMatched(
        f"no topic {'is called' if topic else 'has the type'} {wanted}",
        where=str(recording.files[0]),
        hint=f"did you mean {near[0]}?" if near else f"there are {', '.join(known) or 'none'}",
    )


def _definition(channel: Channel) -> Definition:
    if channel.definition is None:
        raise BagError(channel.problem or f"no definition of {channel.msgtype} is known", where=channel.topic)
    return channel.definition


def _row(batch: RawBatch, row: int) -> pa.StructArray:
    one = np.array([row])
    alone = replace(
        batch,
        log_times=batch.log_times[one],
        starts=batch.starts[one],
        lengths=batch.lengths[one],
        offsets=batch.offsets[one],
    )
    decoded = decoder_for(batch.channel).decode(alone)
    if decoded.failures:
        failure = decoded.failures[0]
        raise DecodeError(failure.reason, rule=failure.rule, where=batch.channel.topic)
    return decoded.rows
