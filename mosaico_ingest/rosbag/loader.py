"""This file reads a recording message by message, as dictionaries, in the order they were recorded."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import TracebackType

import numpy as np
from typing_extensions import Self

from mosaico_ingest.errors import BagError, DecodeError, NothingMatched
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.patterns import select
from mosaico_ingest.job.values import LoaderErrorPolicy, Stores
from mosaico_ingest.remote import as_path
from mosaico_ingest.rosbag.blocks import (
    Channel,
    Encoding,
    RawBatch,
    ROSMessage,
    UnreadableRange,
)
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording, span, windows
from mosaico_ingest.rosbag.serialization import Deserializer

__all__ = ["ROSLoader"]

_LOG = logging.getLogger("mosaico_ingest.rosbag")


class ROSLoader:
    """A recording's messages under a list of topic patterns; iterate it, once or again, and close it.

    A message whose bytes do not fit its type is left out and counted in `rejected`; the policy says whether it is
    also logged or raised. What the container lost is in `unreadable` after an iteration.
    """

    def __init__(
        self,
        file_path: Path | str | Sequence[Path | str],
        topics: str | Sequence[str] | None = None,
        typestore_name: Stores | str | None = None,
        error_policy: LoaderErrorPolicy | str = LoaderErrorPolicy.LOG_WARN,
        custom_types: Mapping[str, Path | str] | None = None,
        *,
        ros_distro: Stores | str | None = None,
        custom_msgs: Sequence[CustomMessages] = (),
    ) -> None:
        """Open a file, a directory, or the parts of one recording; `custom_types` gives a text or file per type.

        Raises:
            BagError: It cannot be opened, or a definition cannot be read.
            NothingMatched: The patterns select no topic.
        """
        self._policy = LoaderErrorPolicy(error_policy)
        self._resolver = TypeResolver(ros_distro or typestore_name, custom_msgs, types=custom_types)
        paths = [file_path] if isinstance(file_path, (str, Path)) else list(file_path)
        self._recording: Recording = open_recording([as_path(path) for path in paths], resolve=self._resolver)
        try:
            self._channels = _selected(self._recording, topics)
        except NothingMatched:
            self._recording.close()
            raise
        self.rejected = Counter[str]()
        """How many messages of each topic the last iteration left out."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._recording.close()

    @property
    def topics(self) -> list[str]:
        """The selected topics, by name."""
        return sorted({channel.topic for channel in self._channels.values()})

    @property
    def msg_types(self) -> list[str]:
        """The types on the selected topics, by name."""
        return sorted({channel.msgtype for channel in self._channels.values()})

    @property
    def duration(self) -> int:
        """Time from the first to the last message of the recording, ns; an unindexed one is read for it."""
        first, last = span(self._recording)
        return last - first

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is odd about the recording and its definitions."""
        return (*self._recording.findings, *self._resolver.findings)

    @property
    def unreadable(self) -> tuple[UnreadableRange, ...]:
        """What of the recording could not be read, found so far."""
        return self._recording.unreadable

    def msg_count(self, topic: str | None = None) -> int:
        """Return how many messages a selected topic has, or all of them; an unindexed recording is read for it.

        Raises:
            NothingMatched: The topic is not among the selected.
        """
        channels = [channel for channel in self._channels.values() if topic in {None, channel.topic}]
        if not channels:
            raise _nothing(f"the topic {topic!r} is not selected", [str(topic)], self.topics)
        counts = [channel.count for channel in channels]
        if None in counts:
            return sum(len(batch) for batch in self._recording.batches([channel.id for channel in channels]))
        return sum(count for count in counts if count is not None)

    def __iter__(self) -> Iterator[ROSMessage]:
        """Yield the messages by log time.

        Raises:
            BagError: The recording itself is unreadable, or, under `raise`, a message or a topic's definition is.
        """
        self.rejected.clear()
        readers = dict(self._readers())
        unreadable = self._channels.keys() - readers
        for batches in windows(self._recording, self._channels):
            for batch in batches:
                if batch.channel.id in unreadable:
                    self.rejected[batch.channel.topic] += len(batch)
            yield from self._messages([batch for batch in batches if batch.channel.id in readers], readers)
        if self._policy is LoaderErrorPolicy.LOG_WARN:
            for topic, count in self.rejected.items():
                _LOG.warning("%s: %d messages could not be read", topic, count)

    def _readers(self) -> Iterator[tuple[int, Deserializer]]:
        for channel in self._channels.values():
            if channel.definition and channel.encoding is not Encoding.OTHER:
                yield channel.id, Deserializer(channel.definition, channel.encoding)
            else:
                self._complain(channel.topic, channel.problem or "it is not in a ROS encoding")

    def _complain(self, topic: str, problem: str) -> None:
        if self._policy is LoaderErrorPolicy.RAISE:
            raise BagError(problem, where=topic)
        if self._policy is LoaderErrorPolicy.LOG_WARN:
            _LOG.warning("%s: %s", topic, problem)

    def _messages(self, batches: list[RawBatch], readers: Mapping[int, Deserializer]) -> Iterator[ROSMessage]:
        if not batches:
            return
        times = np.concatenate([batch.log_times for batch in batches])
        owners = np.repeat(np.arange(len(batches)), [len(batch) for batch in batches])
        rows = np.concatenate([np.arange(len(batch)) for batch in batches])
        for position in np.argsort(times, kind="stable"):
            batch, row = batches[owners[position]], int(rows[position])
            message = self._message(batch, row, readers[batch.channel.id])
            if message:
                yield message

    def _message(self, batch: RawBatch, row: int, reader: Deserializer) -> ROSMessage | None:
        channel = batch.channel
        try:
            data = reader.to_dict(batch.payload(row))
        except DecodeError as error:
            if self._policy is LoaderErrorPolicy.RAISE:
                place = f"{channel.topic} at {int(batch.log_times[row])} ns"
                raise DecodeError(error.what, rule=error.rule, where=place, hint=error.hint) from None
            if not self.rejected[channel.topic] and self._policy is LoaderErrorPolicy.LOG_WARN:
                _LOG.warning("%s: %s", channel.topic, error)
            self.rejected[channel.topic] += 1
            return None
        return ROSMessage(int(batch.log_times[row]), channel.topic, channel.msgtype, data)


def _selected(recording: Recording, topics: str | Sequence[str] | None) -> dict[int, Channel]:
    patterns = [topics] if isinstance(topics, str) else list(topics or ())
    names = sorted({channel.topic for channel in recording.channels})
    chosen = set(select(patterns, names).selected)
    if not chosen:
        what = f"no topic matches {', '.join(patterns)}" if patterns else "the recording has no topic"
        raise _nothing(what, patterns, names)
    return {channel.id: channel for channel in recording.channels if channel.topic in chosen}


def _nothing(what: str, wanted: Sequence[str], names: Sequence[str]) -> NothingMatched:
    near = dict.fromkeys(
        name for pattern in wanted for name in get_close_matches(pattern.lstrip("!"), names, n=3)
    )
    shown = list(near) or list(names)[:5]
    return NothingMatched(what, hint=f"nearest: {', '.join(shown)}" if shown else None)
