"""The messages of a recording as dictionaries, in log-time order."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from typing_extensions import Self

from mosaico_ingest.errors import BagError, DecodeError, NothingMatched
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.values import LoaderErrorPolicy, Stores, select
from mosaico_ingest.remote import RemotePath, as_path
from mosaico_ingest.rosbag.blocks import Connection, MessageBlock, ROSMessage, UnreadableRange
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, TypeResolver
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS
from mosaico_ingest.rosbag.recording import (
    Recording,
    no_topics_error,
    open_recording,
    time_bounds,
    time_slices,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_LOG = logging.getLogger("mosaico_ingest.rosbag")


class _Source(Protocol):
    """The operations of a reader that `ROSLoader` needs."""

    connections: tuple[Connection, ...]

    def close(self) -> None: ...
    def time_bounds(self) -> tuple[int, int]: ...
    def payloads(self, connection_ids: Collection[int]) -> Iterator[tuple[int, int, bytes]]: ...
    def deserializer(self, connection: Connection) -> Callable[[bytes], dict[str, Any]] | None: ...


class ROSLoader:
    """The messages of a recording on selected topics. Iterate it, once or several times, and close it.

    Each item is a message and an exception, as in the official SDK. The exception is None unless the message cannot be
    decoded; such messages have no data and are counted in `rejected`, and the error policy decides whether they are also
    logged, or raised. Damage of the files is listed in `unreadable` after an iteration.
    """

    def __init__(
        self,
        file_path: Path | str | Sequence[Path | str],
        typestore_or_distro: Typestore | Stores | str | None = None,
        topics: str | Sequence[str] | None = None,
        serialization_formats: Mapping[str, Any] | None = None,  # noqa: ARG002 - a parameter of the official SDK
        *,
        error_policy: LoaderErrorPolicy | str = LoaderErrorPolicy.LOG_WARN,
        custom_types: Mapping[str, Path | str] | None = None,
        custom_msgs: Sequence[CustomMessages] = (),
        reader: Literal["native", "rosbags"] = "native",
    ) -> None:
        """Open a file, a directory, or the splits of one recording.

        The positional parameters are those of the official SDK. `typestore_or_distro` has the definitions for recordings
        that contain none: a distro, or a typestore of rosbags. `serialization_formats` has no effect, because a layout
        belongs to stored rows. `custom_types` maps message types to their definition: the text, or a path. `reader`
        selects this package's reader, which also reads damaged and remote recordings, or that of the rosbags library.

        Raises:
            BagError: The recording cannot be opened, is damaged so that no topic is left, or a definition cannot be read.
            NothingMatched: The patterns select no topic.
        """
        self._policy = LoaderErrorPolicy(error_policy)
        distro, types = distro_and_types(typestore_or_distro)
        self._resolver = TypeResolver(distro, custom_msgs, types={**types, **(custom_types or {})})
        paths = [as_path(path) for path in ([file_path] if isinstance(file_path, (str, Path)) else file_path)]
        self._recording: Recording | None = None
        if reader == "rosbags":
            self._source = _open_with_rosbags(paths, self._resolver)
        elif reader == "native":
            self._recording = open_recording(paths, resolve=self._resolver)
            self._source = _NativeSource(self._recording)
        else:
            raise BagError(f"unknown reader {reader!r}", hint="use 'native' or 'rosbags'")
        try:
            if self._recording and not self._recording.connections:
                raise no_topics_error(self._recording)
            self._connections = _select_connections(self._source.connections, topics)
        except (NothingMatched, BagError):
            self.close()
            raise
        self.rejected = Counter[str]()
        """Number of messages that the last iteration could not decode, by topic."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    @property
    def topics(self) -> list[str]:
        """The selected topics, sorted."""
        return sorted({connection.topic for connection in self._connections.values()})

    @property
    def filtered_topics(self) -> list[str]:
        """The topics that the patterns do not select, sorted."""
        return sorted({connection.topic for connection in self._source.connections} - set(self.topics))

    @property
    def resolved_topics(self) -> list[str]:
        """The topics of the recording whose messages can be decoded, sorted; they may be filtered."""
        return sorted({one.topic for one in self._source.connections if self._source.deserializer(one)})

    @property
    def msg_types(self) -> list[str]:
        """The types on the selected topics, sorted."""
        return sorted({connection.msgtype for connection in self._connections.values()})

    @property
    def duration(self) -> int:
        """Nanoseconds between the first and last message; a recording without index is read to determine it."""
        first, last = self._source.time_bounds()
        return last - first

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the recording and its definitions."""
        return (*(self._recording.findings if self._recording else ()), *self._resolver.findings)

    @property
    def unreadable(self) -> tuple[UnreadableRange, ...]:
        """The unreadable ranges found so far; always empty with the reader of rosbags."""
        return self._recording.unreadable if self._recording else ()

    def msg_count(self, topic: str | None = None) -> int:
        """Return the number of messages of a selected topic, or of all; a recording without index is read to count.

        Raises:
            NothingMatched: The topic is not selected.
        """
        connections = [one for one in self._connections.values() if topic in {None, one.topic}]
        if not connections:
            raise _nothing_matched(f"the topic {topic!r} is not selected", [str(topic)], self.topics)
        counts = [connection.count for connection in connections]
        if None in counts:
            return sum(1 for _ in self._source.payloads([connection.id for connection in connections]))
        return sum(count for count in counts if count is not None)

    def __iter__(self) -> Iterator[tuple[ROSMessage, Exception | None]]:
        """Yield the messages by log time, each with the reason why it cannot be decoded, or None.

        Raises:
            BagError: The recording is unreadable; or, with the policy `raise`, a message or a definition is.
        """
        self.rejected.clear()
        deserializers = {key: self._deserializer(one) for key, one in self._connections.items()}
        constants = {key: _constants(one) for key, one in self._connections.items()}
        for log_ns, connection_id, payload in self._source.payloads(self._connections):
            connection, deserialize = self._connections[connection_id], deserializers[connection_id]
            data, problem = dict[str, Any](), None
            try:
                data = deserialize(payload)
            except DecodeError as error:
                self._reject(connection, log_ns, error)
                problem = error
            message = ROSMessage(log_ns, connection.topic, connection.msgtype, data, constants[connection_id])
            yield message, problem
        if self._policy is LoaderErrorPolicy.LOG_WARN:
            for topic, count in self.rejected.items():
                _LOG.warning("%s: %d messages could not be read", topic, count)

    def _deserializer(self, connection: Connection) -> Callable[[bytes], dict[str, Any]]:
        """Return the deserializer of a connection, which raises for every message if there is none."""
        deserialize = self._source.deserializer(connection)
        if deserialize is not None:
            return deserialize
        problem = connection.problem or "it cannot be decoded"
        if self._policy is LoaderErrorPolicy.RAISE:
            raise BagError(problem, where=connection.topic)

        def refuse(payload: bytes) -> dict[str, Any]:  # noqa: ARG001 - the signature of a deserializer
            raise DecodeError(problem, rule="definition")

        return refuse

    def _reject(self, connection: Connection, log_ns: int, error: DecodeError) -> None:
        """Raise or count a message that cannot be decoded; log the first of each topic."""
        if self._policy is LoaderErrorPolicy.RAISE:
            where = f"{connection.topic} at {log_ns} ns"
            raise DecodeError(error.what, rule=error.rule, where=where, hint=error.hint) from None
        if not self.rejected[connection.topic] and self._policy is LoaderErrorPolicy.LOG_WARN:
            _LOG.warning("%s: %s", connection.topic, error)
        self.rejected[connection.topic] += 1


def _constants(connection: Connection) -> dict[str, Any]:
    """Return the constants of a connection's type by name."""
    definition = connection.definition
    return {} if definition is None else {one.name: one.value for one in definition.message.constants}


class _NativeSource:
    """A `Recording` as the source of a loader."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.connections = recording.connections

    def close(self) -> None:
        self._recording.close()

    def time_bounds(self) -> tuple[int, int]:
        return time_bounds(self._recording)

    def payloads(self, connection_ids: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        for blocks in time_slices(self._recording, connection_ids):
            yield from _by_log_time(blocks)

    def deserializer(self, connection: Connection) -> Callable[[bytes], dict[str, Any]] | None:
        entry = MESSAGE_ENCODINGS.get(connection.encoding)
        if connection.definition is None or entry is None:
            return None
        return entry.reader(connection.definition).to_dict


def _by_log_time(blocks: list[MessageBlock]) -> Iterator[tuple[int, int, bytes]]:
    if not blocks:
        return
    times = np.concatenate([block.log_times for block in blocks])
    owners = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])
    rows = np.concatenate([np.arange(len(block)) for block in blocks])
    for position in np.argsort(times, kind="stable"):
        block, row = blocks[owners[position]], int(rows[position])
        yield int(times[position]), block.connection, block.payload(row)


def distro_and_types(
    source: Typestore | Stores | str | None,
) -> tuple[Stores | str | None, Mapping[str, str]]:
    """Return a distro, or the texts of the types in a typestore of rosbags."""
    if source is None or isinstance(source, (str, Enum)):
        return source, {}
    from mosaico_ingest.rosbag.definitions.rosbags_types import definition_texts  # noqa: PLC0415 - imports rosbags

    return Stores.EMPTY, definition_texts(source)


def _open_with_rosbags(paths: Sequence[Path | RemotePath], resolver: TypeResolver) -> _Source:
    from mosaico_ingest.rosbag.rosbags_library import RosbagsRecording  # noqa: PLC0415 - the native reader does not need it

    local = [path for path in paths if isinstance(path, Path)]
    if len(local) < len(paths):
        raise BagError(
            "rosbags reads local files only",
            where=str(paths[0]),
            hint="download the recording, or use the native reader",
        )
    return RosbagsRecording(local, resolver.distro, resolver.custom_texts)


def _select_connections(
    connections: Sequence[Connection], topics: str | Sequence[str] | None
) -> dict[int, Connection]:
    patterns = [topics] if isinstance(topics, str) else list(topics or ())
    names = sorted({connection.topic for connection in connections})
    selected = set(select(patterns, names).selected)
    if not selected:
        what = f"no topic matches {', '.join(patterns)}" if patterns else "the recording has no topics"
        raise _nothing_matched(what, patterns, names)
    return {connection.id: connection for connection in connections if connection.topic in selected}


def _nothing_matched(what: str, patterns: Sequence[str], names: Sequence[str]) -> NothingMatched:
    near = dict.fromkeys(
        name for pattern in patterns for name in get_close_matches(pattern.lstrip("!"), names, n=3)
    )
    suggestions = list(near) or list(names)[:5]
    return NothingMatched(what, hint=f"nearest: {', '.join(suggestions)}" if suggestions else None)
