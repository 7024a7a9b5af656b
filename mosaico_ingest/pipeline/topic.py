"""One topic of a run: decode, adapt and write its messages, and account for each of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from msgspec import Struct, field
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapted, Adapter, Envelope
from mosaico_ingest.decode.decoder import Decoder, decoder_for
from mosaico_ingest.destinations import ENVELOPE, Session, TopicWriter
from mosaico_ingest.errors import AdapterError, BagError, DecodeError, IngestError, SinkError
from mosaico_ingest.findings import RowFailure, Stage
from mosaico_ingest.job.values import LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.lazy import cache_by_identity
from mosaico_ingest.ontology.registry import OntologyType, RequiredFields
from mosaico_ingest.pipeline.plan import TopicPlan
from mosaico_ingest.pipeline.rejections import Quarantine
from mosaico_ingest.pipeline.selection import Conditions, RowSelector, bind_conditions, block_times, row_times
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.events import Observer, Rejected, TopicProgress, TopicStatus
from mosaico_ingest.report.parts import Step, Stopwatch, Timeline
from mosaico_ingest.rosbag.blocks import Connection, Int64s, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape

if TYPE_CHECKING:
    from mosaico_ingest.contracts.monitor import BlockObserver

LATCHED_KEY = "_latched_"
"""Key of topic metadata: `before_ns` is the time before which rows are messages from before the time range."""


class _Rejection(Struct, frozen=True):
    """A message that failed in a stage; `failure.row` is its position in the message block."""

    stage: Stage
    failure: RowFailure


class _OutputRows(Struct, frozen=True):
    """The rows that one message block has in one topic of the sequence."""

    rows: pa.StructArray
    log_times: Int64s
    index: Int64s
    """The position of each row's message in the block."""


class _Converted(Struct, frozen=True):
    """The rows of one message block and the messages that did not become rows, by position in the block."""

    outputs: tuple[_OutputRows, ...]
    """The rows of the topic, and of the other outputs of its adapter."""
    written: Int64s
    """The messages with a row in any output, ascending."""
    rejections: tuple[_Rejection, ...]
    """In the order of the messages."""
    dropped: Mapping[str, Int64s]
    """Positions of the messages that each rule of `topic_settings` and the time range drops."""
    fallbacks: Int64s
    """Positions of the messages whose time is the log time, because they do not have the selected time."""


class TopicPipeline(Struct):
    """Decodes, adapts and writes the messages of one topic, and counts them.

    A message that breaks a policy of `raise` or `finalize` ends the topic at this message: the rows before it are
    written, whatever the size of the blocks. If the adapter has several outputs, the pipeline of the first one processes
    the messages, and `outputs` are the pipelines of the other outputs. Each message is written, dropped or rejected in all outputs.
    """

    plan: TopicPlan
    on_message_error: LoaderErrorPolicy
    session: Session
    observe: Observer
    read: int = 0
    """Number of messages read so far."""
    rows: int = 0
    """Number of rows handed to the destination so far."""
    written: int = 0
    """Number of messages that became rows so far."""
    outputs: list[TopicPipeline] = field(default_factory=list["TopicPipeline"])
    """The pipelines of the other outputs of the adapter."""
    padded: int = 0
    """Number of messages that end in zero bytes their definition does not explain."""
    undeclared: set[str] = field(default_factory=set[str])
    """Fields of messages that their schema does not declare, and that are not stored."""
    start_ns: int | None = None
    end_ns: int | None = None
    status: TopicStatus = TopicStatus.EMPTY
    error: str | None = None
    observers: dict[int, BlockObserver] = field(default_factory=dict)
    """The observers of the data contract by connection."""
    quarantine: Quarantine | None = None
    """Keeps rejected messages; the error policies apply to messages beyond its limits."""
    timeline: Timeline = field(default_factory=Timeline)
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    selector: RowSelector | None = None
    """Selects the rows by time; None keeps all rows."""
    range_start_ns: int | None = None
    """The start of the time range; earlier rows are those of latched messages."""
    dropped: int = 0
    """Number of messages that the settings of the topic and the time range dropped so far."""
    _latched: int = 0
    """Number of messages from before the time range."""
    _leading_failures: int = 0
    """Number of messages that failed before the first row."""
    _connections: dict[int, Connection] = field(default_factory=dict[int, Connection])
    _decoders: dict[int, Decoder] = field(default_factory=dict[int, Decoder])
    _adapters: dict[int, Adapter] = field(default_factory=dict[int, Adapter])
    _conditions: dict[int, Conditions] = field(default_factory=dict)
    _batches: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    """Numbers of rows and messages of each batch; empty as long as every message has one row."""
    _writer: TopicWriter | None = None
    _adapter_metadata: dict[str, Any] | None = None
    """Topic metadata that the adapter derives from the first message."""

    def bind(self, connection: Connection) -> None:
        """Create the decoder and the adapter of one connection.

        Raises:
            BagError: The connection has no definition.
            AdapterError: The adapter does not fit the type.
        """
        if connection.definition is None:
            raise BagError(connection.problem or "no definition of the type is known", where=connection.topic)
        self._connections[connection.id] = connection
        self._adapters[connection.id] = self.plan.adapter.bind(
            connection.definition, ros_shape(connection.definition)
        )
        if self.plan.shares_messages:
            return
        if self.plan.has_conditions:
            self._conditions[connection.id] = bind_conditions(self.plan, connection.definition)
        self._decoders[connection.id] = decoder_for(connection)

    def times_of(self, block: MessageBlock) -> Int64s:
        """Return the selected time of each message of a block, shape (n,)."""
        decoder = self._decoders[block.connection]
        return block_times(block, decoder, self.plan.stamp, self.plan.time_offset_ns)

    def process(self, block: MessageBlock, buffer: WriteBuffer, *, latched: bool = False) -> None:
        """Decode, adapt and write a message block, and account for every message of it.

        Messages before the time range (`latched`) become rows regardless of the settings that drop messages.

        Raises:
            IngestError: An error policy ends the run.
        """
        observer = None if latched else self.observers.get(block.connection)
        if observer is not None:
            observer.block(block.log_times)
        topics = (self, *self.outputs)
        if self.has_ended:
            for topic in topics:
                topic.skip(block)
            return
        converted = self._convert(block, observer, latched=latched)
        fatal, quarantined = self._apply_policies(block, converted)
        end = len(block) if fatal is None else fatal.failure.row + 1
        for topic, output in zip(topics, converted.outputs, strict=True):
            if topic.has_ended:
                topic.skip(block)
                continue
            topic.count(block, end, converted, latched=latched)
            topic.report_rejections(
                block,
                (rejection for rejection in converted.rejections if rejection.failure.row < end),
                quarantined,
            )
            topic.write(block, output, end, int(np.searchsorted(converted.written, end)), buffer)
        if fatal is not None:
            self._stop(fatal, block, end)

    @property
    def has_ended(self) -> bool:
        """Whether no more rows can be written."""
        return self.status in {TopicStatus.FINALIZED, TopicStatus.FAILED}

    def messages_in(self, rows: int) -> int:
        """Return the number of messages in the first rows handed to the destination, which end with a batch."""
        if rows >= self.rows:
            return self.written
        messages = 0
        for batch_rows, batch_messages in self._batches:
            rows -= batch_rows
            if rows < 0:
                return messages
            messages += batch_messages
        return messages + rows

    def skip(self, block: MessageBlock) -> None:
        """Account for messages after the end of the topic."""
        self.count(block, len(block))
        self._reject_from(block, 0)

    def _convert(self, block: MessageBlock, observer: BlockObserver | None, *, latched: bool) -> _Converted:
        """Decode, select and adapt the messages of a block."""
        positions = np.arange(len(block), dtype=np.int64)
        selected = (positions + self.read - self._latched) % self.plan.every == 0
        if latched:
            selected[:] = True
        dropped = {} if selected.all() else {"every": positions[~selected]}
        sample = positions[selected]
        decoded = self._decoders[block.connection].decode(block if selected.all() else block.rows(sample))
        self.stopwatch.lap(Step.DECODE)
        self.padded += decoded.padded
        self.undeclared |= decoded.undeclared
        rejections = [
            _Rejection(Stage.DECODE, replace(failure, row=int(sample[failure.row])))
            for failure in decoded.failures
        ]
        rows, index = decoded.rows, sample[decoded.index]
        publish_times = None if block.publish_times is None else block.publish_times[index]
        times = row_times(
            self.plan.stamp, self.plan.time_offset_ns, rows, block.log_times[index], publish_times
        )
        fallbacks = index[:0] if times.fallback is None else index[times.fallback]
        stamps = times.values
        if self.selector is not None and not latched:
            envelope = self._envelope(block, index)
            conditions = self._conditions.get(block.connection)
            keep, excluded = self.selector.select(stamps, rows, envelope, conditions)
            dropped |= {rule: index[mask] for rule, mask in excluded.items()}
            if keep is not None:
                rows, index, stamps = rows.filter(pa.array(keep)), index[keep], stamps[keep]
        if observer is not None:
            observer.messages(rows, index)
        adapted = self._adapt(rows, self._envelope(block, index), block.connection)
        rejections += [
            _Rejection(Stage.ADAPT, replace(failure, row=int(index[failure.row])))
            for failure in adapted.failures
        ]
        if observer is not None:
            observer.adapted(adapted, index)
        rejections.sort(key=lambda rejection: rejection.failure.row)
        return _Converted(
            tuple(
                _OutputRows(
                    output.rows,
                    stamps[output.index] if output.log_times is None else output.log_times,
                    index[output.index],
                )
                for output in (adapted, *adapted.others)
            ),
            index[adapted.messages],
            tuple(rejections),
            dropped | {rule: index[positions] for rule, positions in adapted.dropped.items()},
            fallbacks,
        )

    def _envelope(self, block: MessageBlock, index: Int64s) -> Envelope:
        """Return the envelope of some messages of a block."""
        envelope = Envelope(
            self.plan.topic, self.plan.msgtype, block.log_times, block.publish_times, block.sequences
        ).take(index)
        return replace(envelope, indices=index + self.read)

    def _adapt(self, rows: pa.StructArray, envelope: Envelope, connection: int) -> Adapted:
        """Adapt messages; if the adapter itself fails, all of them fail."""
        try:
            for topic in (self, *self.outputs) if len(rows) else ():
                topic.note_first_message(connection, rows[0])
            return self._adapters[connection].adapt(rows, envelope)
        except AdapterError as error:
            failures = tuple(RowFailure(row, "adapter-error", str(error)) for row in range(len(rows)))
            nothing = Adapted(rows[:0], np.zeros(0, np.int64), failures)
            return replace(nothing, others=(nothing,) * len(self.outputs))

    def note_first_message(self, connection: int, row: pa.StructScalar) -> None:
        """Derive topic metadata from the first message."""
        if self._adapter_metadata is None:
            self._adapter_metadata = self._adapters[connection].topic_metadata(row)

    def _apply_policies(
        self, block: MessageBlock, converted: _Converted
    ) -> tuple[_Rejection | None, set[int]]:
        """Quarantine rejected messages in order; return the rejection that ends the topic, and the quarantined positions."""
        quarantined: set[int] = set()
        first_row = int(converted.written[0]) if len(converted.written) else len(block)
        for rejection in converted.rejections:
            position = rejection.failure.row
            self._leading_failures += self.written == 0 and position < first_row
            if self._try_quarantine(block, rejection):
                quarantined.add(position)
            elif self._ends_topic(rejection):
                return rejection, quarantined
            if self.quarantine is not None and self._leading_failures == self.quarantine.systematic:
                reason = (
                    f"all of the first {self._leading_failures} messages failed: {rejection.failure.reason}"
                )
                return replace(rejection, failure=replace(rejection.failure, reason=reason)), quarantined
        return None, quarantined

    def _try_quarantine(self, block: MessageBlock, rejection: _Rejection) -> bool:
        return self.quarantine is not None and self.quarantine.add(
            self._connections[block.connection],
            block,
            rejection.failure,
            stage=rejection.stage,
            target=self.plan.target,
            promised=self.plan.count,
            read=self.read + len(block),
        )

    def _ends_topic(self, rejection: _Rejection) -> bool:
        if self.quarantine is not None:
            return self._ends_run(rejection.stage) or self.plan.on_error is TopicLevelErrorPolicy.Finalize
        if rejection.stage is Stage.DECODE:
            return self.on_message_error is LoaderErrorPolicy.RAISE
        return self.plan.on_error is not TopicLevelErrorPolicy.Ignore

    def _ends_run(self, stage: Stage) -> bool:
        """Return whether a message that ends the topic also ends the run."""
        if stage is Stage.DECODE and self.on_message_error is LoaderErrorPolicy.RAISE:
            return True
        return self.plan.on_error is TopicLevelErrorPolicy.Raise

    def _stop(self, fatal: _Rejection, block: MessageBlock, end: int) -> None:
        """End the topic at a rejected message; raise if its policy ends the run."""
        kind = DecodeError if fatal.stage is Stage.DECODE else AdapterError
        offset = int(block.offsets[fatal.failure.row])
        error = kind(fatal.failure.reason, where=f"{self.plan.topic} at offset {offset}")
        topics = (self, *self.outputs)
        for topic in topics:
            topic.error = str(error)
            self.session.note_error(topic.error, topic=topic.plan.target)
        if self._ends_run(fatal.stage):
            raise error
        for topic in topics:
            if topic.status is not TopicStatus.FAILED:
                topic.finalize(block, end)

    def finalize(self, block: MessageBlock, end: int) -> None:
        """Close the topic, and account for the messages of a block from a position on."""
        self.status = TopicStatus.FINALIZED
        remaining = block.lengths[end:]
        if len(remaining):
            self.read += len(remaining)
            self.observe(
                TopicProgress(self.plan.target, read=len(remaining), payload_bytes=int(remaining.sum()))
            )
            self._reject_from(block, end)

    def _reject_from(self, block: MessageBlock, start: int) -> None:
        """Report the messages from a position on as rejected because the topic has ended."""
        self.observe(
            Rejected(
                self.plan.target,
                Stage.WRITE,
                "topic-closed",
                len(block) - start,
                f"the topic was closed: {self.error}",
                int(block.log_times[start]),
                int(block.offsets[start]),
                last_log_time_ns=int(block.log_times[-1]),
            )
        )

    def write(
        self, block: MessageBlock, output: _OutputRows, end: int, written: int, buffer: WriteBuffer
    ) -> None:
        """Queue the rows of messages before a position for the sink; open the topic in the sink with its first rows.

        `written` is the number of these messages that have a row in any output.
        """
        accepted = int(np.searchsorted(output.index, end))
        rows = _columns(self.plan.ontology).batch(output.log_times[:accepted], output.rows[:accepted])
        if self._writer is None and accepted:
            try:
                metadata = {**(self._adapter_metadata or {}), **self.plan.metadata}
                if self._latched:
                    metadata[LATCHED_KEY] = {"before_ns": self.range_start_ns}
                self._writer = self.session.topic(self.plan.target, self.plan.ontology, metadata)
            except SinkError as error:
                self._fail(error, written, block, output.index)
                return
        if accepted != written or self._batches:
            self._batches = self._batches or [(self.rows, self.written)]
            self._batches.append((accepted, written))
        self.rows += accepted
        self.written += written
        if self._writer is None or not accepted:
            self.observe(TopicProgress(self.plan.target, written=written))
            return
        times = rows.column(0).to_numpy()
        first, last = int(times.min()), int(times.max())
        self.timeline.add(times)
        self.start_ns = first if self.start_ns is None else min(self.start_ns, first)
        self.end_ns = last if self.end_ns is None else max(self.end_ns, last)
        self.status = TopicStatus.WRITTEN
        # `put` may end the run, so rows are counted before; rows that are not stored are subtracted afterwards.
        self.observe(
            TopicProgress(self.plan.target, written=written, rows=accepted, start_ns=first, end_ns=last)
        )
        self.stopwatch.lap(Step.ADAPT)
        buffer.put(self._writer, rows)
        self.stopwatch.lap(Step.WAIT)

    def _fail(self, error: IngestError, written: int, block: MessageBlock, index: Int64s) -> None:
        """Mark the topic as failed; raise if its error policy ends the run."""
        self.status, self.error = TopicStatus.FAILED, str(error)
        first = int(index[0])
        self.observe(
            Rejected(
                self.plan.target,
                Stage.WRITE,
                "topic-refused",
                written,
                self.error,
                int(block.log_times[first]),
                int(block.offsets[first]),
                last_log_time_ns=int(block.log_times[int(index[-1])]),
            )
        )
        if self.plan.on_error is TopicLevelErrorPolicy.Raise:
            raise error

    def count(
        self, block: MessageBlock, end: int, converted: _Converted | None = None, *, latched: bool = False
    ) -> None:
        """Count the messages of a block before a position."""
        self.read += end
        self._latched += end if latched else 0
        dropped = {
            rule: int((positions < end).sum())
            for rule, positions in (converted.dropped.items() if converted else ())
        }
        self.dropped += sum(dropped.values())
        self.observe(
            TopicProgress(
                self.plan.target,
                read=end,
                dropped=dropped,
                latched=end if latched else 0,
                stamp_fallbacks=int((converted.fallbacks < end).sum()) if converted else 0,
                payload_bytes=int(block.lengths[:end].sum()),
            )
        )

    def report_rejections(
        self, block: MessageBlock, rejections: Iterable[_Rejection], quarantined: set[int]
    ) -> None:
        """Emit one event per stage and rule, with the first message as the example."""
        groups: dict[tuple[Stage, str], list[RowFailure]] = {}
        for rejection in rejections:
            groups.setdefault((rejection.stage, rejection.failure.rule), []).append(rejection.failure)
        for (stage, rule), failures in groups.items():
            first = failures[0]
            self.observe(
                Rejected(
                    self.plan.target,
                    stage,
                    rule,
                    len(failures),
                    first.reason,
                    int(block.log_times[first.row]),
                    int(block.offsets[first.row]),
                    sum(failure.row in quarantined for failure in failures),
                    int(block.log_times[failures[-1].row]),
                )
            )


def link_outputs(pipelines: Sequence[TopicPipeline]) -> None:
    """Let the pipeline that processes messages also write to the other topics that share them."""
    readers = pipelines_by_connection(pipelines)
    for pipeline in pipelines:
        if pipeline.plan.shares_messages:
            readers[pipeline.plan.connections[0]].outputs.append(pipeline)


def pipelines_by_connection(pipelines: Iterable[TopicPipeline]) -> dict[int, TopicPipeline]:
    """Return the pipeline that processes the messages of each connection."""
    return {
        connection: pipeline
        for pipeline in pipelines
        if not pipeline.plan.shares_messages
        for connection in pipeline.plan.connections
    }


@cache_by_identity
def _columns(ontology: OntologyType) -> _Columns:
    return _Columns(ontology.struct)


class _Columns:
    """The schema of a topic's batches: the timestamp column, then the fields of the ontology type."""

    def __init__(self, kind: pa.StructType) -> None:
        self.kind = kind
        self._schema = pa.schema([ENVELOPE, *kind])
        self._required = RequiredFields(kind)

    def batch(self, log_times: Int64s, rows: pa.StructArray) -> pa.RecordBatch:
        """Return a batch of the timestamps and the rows' fields."""
        if rows.type != self.kind:  # the sink reports the difference
            return _Columns(rows.type).batch(log_times, rows)
        columns = self._required.fill(rows).flatten()
        return pa.RecordBatch.from_arrays([pa.array(log_times), *columns], schema=self._schema)
