"""Monitors: they observe the messages of a recording while it is read, and return the results of its contract."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from msgspec import Struct, field

from mosaico_ingest.contracts import ORDER_KEYS, ROW_KEYS, Clause, Contract, ReadTopic
from mosaico_ingest.contracts.evaluate import Facts, TopicFacts, evaluate, limit_result
from mosaico_ingest.contracts.times import FileOrder, Gaps, Int64s, SlidingWindow, TopicTimes, read_events
from mosaico_ingest.contracts.values import Batch
from mosaico_ingest.display import count_text, counted
from mosaico_ingest.job.values import RECORDING, Interval, OnFailure
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Outcome
from mosaico_ingest.rosbag.blocks import ChunkChecksum, Connection
from mosaico_ingest.rosbag.recording import Recording

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import Adapted
    from mosaico_ingest.contracts.rows import RowMonitor

_NONE = np.zeros(0, np.int64)


class RecordingMonitor:
    """Observes the messages of a recording for a contract whose expressions fit its topics (`rows.check_expressions`)."""

    def __init__(
        self,
        contract: Contract,
        recording: Recording,
        topics: Sequence[ReadTopic],
        *,
        excluded: Mapping[str, str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        """Create the monitor.

        Args:
            contract: The contract.
            recording: The open recording.
            topics: The topics whose messages will be observed.
            excluded: The reasons why other topics are not read, by name.
            start_ns: The start of the time range that is read, None for all messages.
            end_ns: The end of the time range, exclusive.
        """
        self._contract = contract
        self._recording = recording
        self._excluded = excluded or {}
        self._range = (start_ns, end_ns)
        self._connections = {connection.id: connection for connection in recording.connections}
        self._of_topic: dict[str, tuple[int, ...]] = {}
        self._monitors: dict[str, TopicMonitor] = {}
        self._outputs: dict[str, TopicMonitor | None] = {}
        """The monitors of the outputs of adapters; None if nothing is expected of an output."""
        self._output_types: dict[str, dict[str, None]] = {}
        """The message types whose messages each output has rows of."""
        self._outputs_of: dict[int, tuple[TopicMonitor | None, ...]] = {}
        """The monitors of the outputs of each connection, if something is expected of one of them."""
        references = referenced_topics(contract)
        for topic in topics:
            self._add(topic, references)
        self.order = file_order(contract, self._monitors, is_mcap=recording.container == "mcap")
        """Observes the messages in the order of the files; None if no expectation needs it."""

    @property
    def on_failure(self) -> OnFailure:
        """The action if an expectation with the severity `error` fails."""
        return self._contract.expect.on_failure

    def observer(self, connection: int) -> BlockObserver | None:
        """Return the observer of the blocks of a connection, None if nothing about its topic is expected."""
        monitor = self._monitors.get(self._connections[connection].topic)
        if monitor is None:
            return None
        start_ns, end_ns = self._range
        rows, outputs = monitor.rows.get(connection), self._outputs_of.get(connection, ())
        return BlockObserver(monitor, connection, rows, start_ns, end_ns, outputs)

    @property
    def observed(self) -> Mapping[str, TopicMonitor]:
        """The monitors by topic."""
        return self._monitors

    def reject(self, topic: str, count: int) -> None:
        """Add rejected messages of a topic, after its messages were converted."""
        monitor = self._monitors.get(topic)
        if monitor is not None:
            monitor.rejected = (monitor.rejected or 0) + count

    def finish(self) -> ContractResult:
        """Return the results, after all messages were observed."""
        for monitor in (*self._monitors.values(), *self._outputs.values()):
            if monitor is not None:
                monitor.finish()
        facts = self._facts()
        return evaluate(
            self._contract,
            facts,
            {
                "unreadable": lambda clause: self._unreadable(clause, facts),
                "chunk_crcs": self._chunk_checksums,
                "metadata_counts": lambda clause: self._metadata_counts(clause, facts),
            },
        )

    def _add(self, topic: ReadTopic, references: frozenset[str]) -> None:
        known_connections = self._of_topic.get(topic.topic, ())
        self._of_topic[topic.topic] = (*known_connections, *topic.connections)
        if self._add_outputs(topic, references):
            references |= {topic.topic}
        monitor = self._monitors.get(topic.topic) or topic_monitor(self._contract, topic.topic, references)
        if monitor is None:
            return
        self._monitors[topic.topic] = monitor
        if monitor.has_rows:
            from mosaico_ingest.contracts.rows import connection_monitor  # noqa: PLC0415 - log times need no Arrow functions

            for key in topic.connections:
                rows, _ = connection_monitor(self._contract, self._connections[key], topic)
                if rows is not None:
                    monitor.rows[key] = rows
        filled = [key for key in self._of_topic[topic.topic] if self._connections[key].count != 0]
        monitor.is_merged = len(filled) > 1

    def _add_outputs(self, topic: ReadTopic, references: frozenset[str]) -> bool:
        """Add the monitors of the outputs of a topic's adapter; return whether something is expected of one of them."""
        msgtypes = dict.fromkeys(self._connections[key].msgtype for key in topic.connections)
        for name, _ in topic.outputs:
            is_known = name in self._outputs
            if not is_known:
                own_name = {name} if self._contract.lists(name) else set[str]()
                self._outputs[name] = topic_monitor(self._contract, name, references | own_name)
            self._output_types[name] = self._output_types.get(name, {}) | msgtypes
            monitor = self._outputs[name]
            if monitor is not None:
                monitor.is_merged = is_known or len(topic.connections) > 1
        monitors = tuple(self._outputs[name] for name, _ in topic.outputs)
        if not any(monitors):
            return False
        from mosaico_ingest.contracts.rows import output_monitor  # noqa: PLC0415 - as for the rows of topics

        for key in topic.connections:
            self._outputs_of[key] = monitors
            for monitor, (name, ontology) in zip(monitors, topic.outputs, strict=True):
                if monitor is not None and monitor.has_rows:
                    rows, _ = output_monitor(self._contract, self._connections[key], name, ontology)
                    if rows is not None:
                        monitor.rows[key] = rows
        return True

    def _facts(self) -> Facts:
        recording = self._recording
        topics: dict[str, TopicFacts] = {}
        for name in dict.fromkeys(connection.topic for connection in recording.connections):
            own = [connection for connection in recording.connections if connection.topic == name]
            filled = [connection for connection in own if connection.count != 0] or own
            topics[name] = TopicFacts(
                name,
                tuple(dict.fromkeys(connection.msgtype for connection in filled)),
                count=self._count(name, own),
                monitor=self._monitors.get(name),
                unread=self._excluded.get(name),
            )
        for name, monitor in self._outputs.items():
            count = None if monitor is None or not monitor.is_observed else monitor.read
            topics[name] = TopicFacts(
                name, tuple(self._output_types[name]), count=count, monitor=monitor, is_output=True
            )
        start_ns, end_ns = self._span()
        return Facts(
            topics,
            start_ns=start_ns,
            end_ns=end_ns,
            read_events=lambda: read_events(recording),
            order=self.order,
            connections=self._of_topic,
        )

    def _count(self, name: str, connections: Sequence[Connection]) -> int | None:
        monitor = self._monitors.get(name)
        if monitor is not None:
            return monitor.read
        counts = [connection.count for connection in connections]
        total = None if None in counts else sum(count or 0 for count in counts)
        return None if total and self._range != (None, None) else total

    def _span(self) -> tuple[int | None, int | None]:
        """Return the first and last log time, within the time range that is read."""
        start_ns, end_ns = self._recording.start_ns, self._recording.end_ns
        if start_ns is None or end_ns is None:
            spans = [(m.times.first_ns, m.times.last_ns) for m in self._monitors.values()]
            start_ns = min((first for first, _ in spans if first is not None), default=None)
            end_ns = max((last for _, last in spans if last is not None), default=None)
        first, end = self._range
        if start_ns is not None and first is not None:
            start_ns = max(start_ns, first)
        if end_ns is not None and end is not None:
            end_ns = min(end_ns, end - 1)
        return start_ns, end_ns

    def _unreadable(self, clause: Clause, facts: Facts) -> ExpectationResult:
        ranges = [item for item in self._recording.unreadable if item.count != 0]
        count = sum(1 if item.count is None else item.count for item in ranges)
        total = count + (facts.count or sum(monitor.read for monitor in self._monitors.values()))
        reason = f"; the first: {ranges[0].reason}" if ranges else ""
        result = limit_result(clause, clause.expected.max, count, total, "messages are unreadable")
        return result.replace(text=f"{result.text}{reason}") if ranges else result

    def _chunk_checksums(self, clause: Clause) -> ExpectationResult:
        counts = self._recording.chunk_checksums
        if counts is None:
            return clause.skipped(f"the format {self._recording.container} has no checksums of chunks")
        total = sum(counts.values())
        if not total:
            return clause.skipped("the recording has no chunks, or none was read")
        absent, wrong = counts[ChunkChecksum.ABSENT], counts[ChunkChecksum.WRONG]
        expected = clause.expected
        problems = [f"{counted(absent, 'chunk')} of {count_text(total)} have no checksum"] * (
            expected.present and absent > 0
        )
        problems += [f"the checksums of {counted(wrong, 'chunk')} of {count_text(total)} are wrong"] * (
            expected.valid and wrong > 0
        )
        if not problems:
            return clause.passed(f"the checksums of {counted(total - absent, 'chunk')} are valid", measured=0)
        bad = absent * expected.present + wrong * expected.valid
        return clause.failed(
            " and ".join(problems), measured=bad, unit="chunks", limit="no chunk", violations=bad
        )

    def _metadata_counts(self, clause: Clause, facts: Facts) -> ExpectationResult:
        metadata = self._recording.metadata
        if metadata is None:
            return clause.skipped("the recording has no metadata.yaml")
        promised = {topic.topic: topic.count for topic in metadata.topics}
        counts: dict[str, int | None] = {}
        for connection in self._recording.connections:
            before, count = counts.get(connection.topic, 0), self._count_in_files(connection)
            counts[connection.topic] = None if before is None or count is None else before + count
        if None in counts.values() and self._range == (None, None):
            counts = {name: topic.count for name, topic in facts.topics.items() if not topic.is_output}
        different = [
            f"{name}: {count_text(promised.get(name, 0))} in metadata.yaml, {count_text(count)} in the files"
            for name in dict.fromkeys([*promised, *counts])
            if (count := counts.get(name, 0)) is not None and promised.get(name, 0) != count
        ]
        if not different:
            return clause.passed(
                "the counts equal those in metadata.yaml", measured=0, unit="topics", limit="no topic"
            )
        more = f"; {len(different) - 1} more topics differ" if len(different) > 1 else ""
        return clause.failed(
            f"{different[0]}{more}",
            measured=len(different),
            unit="topics",
            limit="no topic",
            violations=len(different),
        )

    def _count_in_files(self, connection: Connection) -> int | None:
        """Return the number of messages in the files' indexes; messages that only `metadata.yaml` promises do not count."""
        absent = sum(
            item.count or 0
            for item in self._recording.unreadable
            if item.connection == connection.id and item.file.endswith("metadata.yaml")
        )
        return None if connection.count is None else connection.count - absent


def summary(result: ContractResult) -> dict[str, Any]:
    """Return the results for the metadata of a sequence: counts, the failures, and the measured values.

    `measured` has a mapping per topic, with the names that metadata keys may have: `/gps/fix` is `gps_fix`.
    """
    measured: dict[str, dict[str, Any]] = {}
    for one in result.results:
        if one.measured is not None:
            values = measured.setdefault(_metadata_key(one.topic or "recording"), {})
            values[_metadata_key(one.key)] = one.measured
    return {
        "passed": result.passed,
        "expectations": len(result.results),
        "failed": len(result.errors),
        "warnings": len(result.warnings),
        "skipped": sum(one.outcome is Outcome.SKIPPED for one in result.results),
        "failures": [one.line for one in (*result.errors, *result.warnings)],
        "measured": measured,
    }


def _metadata_key(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_") or "_"


class TopicMonitor(Struct):
    """Observes the messages of one topic."""

    name: str
    clauses: Mapping[str, Clause]
    times: TopicTimes
    rows: dict[int, RowMonitor] = field(default_factory=dict[int, "RowMonitor"])
    """By connection."""
    has_rows: bool = False
    """Whether an expectation refers to rows, not only to log times and the order in the files."""
    is_merged: bool = False
    """Whether the topic has several connections, whose log times are merged at the end."""
    read: int = 0
    rejected: int | None = None
    """Number of rejected messages; None if the messages were not converted."""
    _counts: dict[int, int] = field(default_factory=lambda: defaultdict[int, int](int))
    """Number of messages of each connection so far."""
    _times: list[Int64s] = field(default_factory=list[Int64s])

    @property
    def is_observed(self) -> bool:
        """Whether a block was observed, even if it has no message."""
        return bool(self._counts)

    def add_block(self, connection: int, log_times: Int64s) -> int:
        """Add the log times of a message block, which are sorted; return the position of its first message."""
        position = self._counts[connection]
        self._counts[connection] = position + len(log_times)
        self.read += len(log_times)
        if self.is_merged:
            self._times.append(log_times)
        else:
            self.times.add(log_times)
        return position

    def finish(self) -> None:
        """Complete the accumulators after the last block."""
        if self._times:
            self.times.add(np.sort(np.concatenate(self._times)))
            self._times = []
        self.times.finish()
        for rows in self.rows.values():
            rows.finish()


class BlockObserver(Struct):
    """Passes the blocks of one connection to the monitors of its topic; called in this order for each block."""

    topic: TopicMonitor
    connection: int
    rows: RowMonitor | None
    start_ns: int | None = None
    """Start of the observed log times; None for all of them."""
    end_ns: int | None = None
    """End of the observed log times, exclusive."""
    outputs: tuple[TopicMonitor | None, ...] = ()
    """The monitors of the outputs of the adapter, whose rows they observe like stored rows; None if nothing is expected."""
    _first: int = 0
    """Position on the topic of the first observed message of the current block."""
    _skipped: int = 0
    """Number of messages of the current block before the range."""
    _log_times: Int64s = _NONE
    """Log times of the observed messages of the current block."""

    @property
    def needs_rows(self) -> bool:
        """Whether log times are not enough."""
        return self.rows is not None or bool(self.outputs)

    def block(self, log_times: Int64s) -> None:
        """Start with a block of messages, whose log times are sorted."""
        start = 0 if self.start_ns is None else int(np.searchsorted(log_times, self.start_ns))
        end = None if self.end_ns is None else int(np.searchsorted(log_times, self.end_ns))
        self._skipped, self._log_times = start, log_times[start:end]
        self._first = self.topic.add_block(self.connection, self._log_times)

    def messages(self, rows: pa.StructArray, index: Int64s) -> None:
        """Add the decoded messages of the block; `index` is the position of each row in it."""
        if self.rows is not None and self.rows.needs_messages:
            self.rows.add_messages(*self._observed(rows, index))

    def adapted(self, adapted: Adapted, index: Int64s) -> None:
        """Add the ontology rows of the block; `index` is the position in it of each message that was adapted."""
        if self.rows is not None and self.rows.needs_ontology and not self.outputs:
            self.rows.add_ontology(*self._observed(adapted.rows, index[adapted.index]))
        if self.outputs:
            for monitor, output in zip(self.outputs, (adapted, *adapted.others), strict=True):
                if monitor is not None:
                    self._add_output(monitor, *self._observed(output.rows, index[output.index]))

    def _add_output(self, monitor: TopicMonitor, rows: pa.StructArray, messages: Batch) -> None:
        first = monitor.add_block(self.connection, messages.log_times)
        of_rows = monitor.rows.get(self.connection)
        if of_rows is not None:
            of_rows.add_stored(rows, Batch(messages.log_times, first))

    def _observed(self, rows: pa.StructArray, index: Int64s) -> tuple[pa.StructArray, Batch]:
        """Return the rows inside the range, with their log times and positions on the topic."""
        count = len(self._log_times)
        if len(index) == count and _are_consecutive(index, self._skipped):
            return rows, Batch(self._log_times, self._first)
        positions = index - self._skipped
        inside = (positions >= 0) & (positions < count)
        if not inside.all():
            rows, positions = rows.filter(pa.array(inside)), positions[inside]
        return rows, Batch(self._log_times[positions], self._first, positions)


def _are_consecutive(index: Int64s, first: int) -> bool:
    """Return whether an ascending index has every position from `first`, each of them once."""
    count = len(index)
    return not count or (
        int(index[0]) == first
        and int(index[-1]) == first + count - 1
        and bool((index[1:] > index[:-1]).all())
    )


def topic_monitor(contract: Contract, name: str, references: Iterable[str] = ()) -> TopicMonitor | None:
    """Return the monitor of a topic without rows; None if nothing about its messages is expected.

    `references` are the topics whose time span an expectation of another topic refers to.
    """
    clauses = contract.topic_clauses(name)
    has_fields = any(True for _ in contract.field_clauses(name))
    if not clauses and not has_fields and name not in references:
        return None
    times = TopicTimes()
    if "gap" in clauses:
        times.gaps["gap"] = Gaps(Interval(ns=clauses["gap"].expected.max))
    if "gaps" in clauses:
        times.gaps["gaps"] = Gaps(clauses["gaps"].expected.over)
    if "coverage" in clauses:
        times.gaps["coverage"] = Gaps(clauses["coverage"].expected.gap)
    if "sliding_rate" in clauses:
        expected = clauses["sliding_rate"].expected
        seconds = expected.window / 1e9
        times.windows["sliding_rate"] = SlidingWindow(
            expected.window,
            -np.inf if expected.min is None else expected.min * seconds - 1e-9,
            np.inf if expected.max is None else expected.max * seconds + 1e-9,
        )
    has_rows = has_fields or bool(clauses.keys() & ROW_KEYS)
    return TopicMonitor(name, clauses, times, has_rows=has_rows)


def referenced_topics(contract: Contract) -> frozenset[str]:
    """Return the topics that `of` names in any expectation."""
    entries = contract.expect.topics.values()
    proximities = (getattr(entry, key) for entry in entries for key in ("coverage", "start", "end"))
    return frozenset(item.of for item in proximities if item is not None and item.of != RECORDING)


def file_order(contract: Contract, topics: Iterable[str], *, is_mcap: bool) -> FileOrder | None:
    """Return the observer of the order in the files, or None if no topic needs it."""
    keys = {key for topic in topics for key in contract.topic_clauses(topic)} & ORDER_KEYS
    if "out_of_order" in keys or (is_mcap and keys):
        return FileOrder(has_numbers=is_mcap)
    return None
