"""This file is one topic of a plan at work: every message that comes in is written, left out or accounted for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Adapted, Adapter, Envelope
from mosaico_ingest.caching import cache_by_identity
from mosaico_ingest.decode.decoder import Decoder, decoder_for
from mosaico_ingest.destinations.base import ENVELOPE, Session, TopicWriter
from mosaico_ingest.errors import (
    AdapterError,
    BagError,
    DecodeError,
    IngestError,
    SinkError,
)
from mosaico_ingest.findings import RowFailure, Stage
from mosaico_ingest.job.values import LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.ontology.types import OntologyType, RequiredFields
from mosaico_ingest.pipeline.plan import TopicPlan
from mosaico_ingest.pipeline.quarantine import Quarantine
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.events import (
    Observer,
    Rejected,
    TopicProgress,
    TopicStatus,
)
from mosaico_ingest.report.timing import Step, Stopwatch, Timeline
from mosaico_ingest.rosbag.blocks import Connection, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape

__all__ = ["Stream"]


class _Lost(Struct, frozen=True):
    """A message that did not go through, at its position in the raw batch."""

    stage: Stage
    failure: RowFailure


class _Translated(Struct, frozen=True):
    """What became of a raw batch: rows, where they were in it, what was lost, what was sampled away."""

    rows: pa.StructArray
    log_times: NDArray[np.int64]
    index: NDArray[np.int64]
    lost: tuple[_Lost, ...]
    skipped: NDArray[np.int64]


@dataclass(slots=True)
class Stream:
    """A topic's adapters by connection, its writer once there are rows, and its sums.

    A message that breaks a policy of `raise` or `finalize` ends the stream there: rows before it are
    written, whatever the size of the batches.
    """

    plan: TopicPlan
    on_message_error: LoaderErrorPolicy
    session: Session
    observe: Observer
    seen: int = 0
    """Messages read so far."""
    rows: int = 0
    """Rows handed to the destination so far."""
    padded: int = 0
    """Messages that ended in zero bytes their definition does not explain."""
    start_ns: int | None = None
    end_ns: int | None = None
    status: TopicStatus = TopicStatus.EMPTY
    error: str | None = None
    quarantine: Quarantine | None = None
    """Takes rejected messages; the policies come into play where it does not."""
    _leading: int = 0
    """How many messages failed before the first good one."""
    timeline: Timeline = field(default_factory=Timeline)
    watch: Stopwatch = field(default_factory=Stopwatch)
    _connections: dict[int, Connection] = field(default_factory=dict[int, Connection])
    _decoders: dict[int, Decoder] = field(default_factory=dict[int, Decoder])
    _adapters: dict[int, Adapter] = field(default_factory=dict[int, Adapter])
    _writer: TopicWriter | None = None
    _configuration: dict[str, Any] | None = None
    """What the adapter says of the topic, from its first message."""

    def bind(self, connection: Connection) -> None:
        """Make the decoder and the adapter of one connection.

        Raises:
            BagError: The connection has no definition.
            AdapterError: The adapter does not fit it.
        """
        if connection.definition is None:
            raise BagError(connection.problem or "no definition of its type is known", where=connection.topic)
        self._connections[connection.id] = connection
        self._decoders[connection.id] = decoder_for(connection)
        self._adapters[connection.id] = self.plan.adapter.bind(
            connection.definition, ros_shape(connection.definition)
        )

    def feed(self, batch: MessageBlock, buffer: WriteBuffer) -> None:
        """Take a batch all the way; account for every message of it.

        Raises:
            IngestError: A policy says that the run ends here.
        """
        if self.status in {TopicStatus.FINALIZED, TopicStatus.FAILED}:
            self.seen += len(batch)
            self._count(batch, len(batch))
            self._reject_rest(batch, 0)
            return
        done = self._translate(batch)
        fatal, quarantined = self._judge(batch, done)
        end = len(batch) if fatal is None else fatal.failure.row + 1
        self._count(batch, end, downsampled=int((done.skipped < end).sum()))
        self._reject(batch, (lost for lost in done.lost if lost.failure.row < end), quarantined)
        kept = int(np.searchsorted(done.index, end))
        if kept:
            rows = _columns(self.plan.ontology).batch(done.log_times[:kept], done.rows[:kept])
            self._write(rows, batch, done.index, buffer)
        if fatal is not None:
            self._end(fatal, batch, end)

    def _translate(self, batch: MessageBlock) -> _Translated:
        positions = np.arange(len(batch), dtype=np.int64)
        taken = (positions + self.seen) % self.plan.every == 0
        self.seen += len(batch)
        keep = positions[taken]
        sampled = batch if taken.all() else batch.rows(keep)
        decoded = self._decoders[batch.connection].decode(sampled)
        self.watch.lap(Step.DECODE)
        self.padded += decoded.padded
        lost = [_Lost(Stage.DECODE, replace(f, row=int(keep[f.row]))) for f in decoded.failures]
        index = keep[decoded.index]
        envelope = Envelope(self.plan.topic, self.plan.msgtype, batch.log_times[index])
        adapter = self._adapters[batch.connection]
        try:
            if self._configuration is None and len(decoded.rows):
                self._configuration = adapter.topic_metadata(decoded.rows[0])
            adapted = adapter.adapt(decoded.rows, envelope)
        except AdapterError as error:
            broken = tuple(RowFailure(row, "adapter-error", str(error)) for row in range(len(index)))
            adapted = Adapted(decoded.rows[:0], index[:0], broken)
        lost += [_Lost(Stage.ADAPT, replace(f, row=int(index[f.row]))) for f in adapted.failures]
        times = envelope.log_times[adapted.index] if adapted.log_times is None else adapted.log_times
        lost.sort(key=lambda one: one.failure.row)
        return _Translated(adapted.rows, times, index[adapted.index], tuple(lost), positions[~taken])

    def _judge(self, batch: MessageBlock, done: _Translated) -> tuple[_Lost | None, set[int]]:
        """Quarantine lost messages in their order; return the one that ends the topic, and the rows that were quarantined."""
        quarantined: set[int] = set()
        first_good = int(done.index[0]) if len(done.index) else len(batch)
        for lost in done.lost:
            row = lost.failure.row
            self._leading += self.rows == 0 and row < first_good
            if self._try_quarantine(batch, lost):
                quarantined.add(row)
            elif self._ends_topic(lost):
                return lost, quarantined
            if self.quarantine is not None and self._leading == self.quarantine.systematic:
                reason = f"none of the first {self._leading} messages could be used: {lost.failure.reason}"
                return replace(lost, failure=replace(lost.failure, reason=reason)), quarantined
        return None, quarantined

    def _try_quarantine(self, batch: MessageBlock, lost: _Lost) -> bool:
        return self.quarantine is not None and self.quarantine.take(
            self._connections[batch.connection],
            batch,
            lost.failure,
            stage=lost.stage,
            target=self.plan.target,
            promised=self.plan.count,
            read=self.seen,
        )

    def _ends_topic(self, lost: _Lost) -> bool:
        if self.quarantine is not None:
            return self._ends_run(lost.stage) or self.plan.on_error is TopicLevelErrorPolicy.Finalize
        if lost.stage is Stage.DECODE:
            return self.on_message_error is LoaderErrorPolicy.RAISE
        return self.plan.on_error is not TopicLevelErrorPolicy.Ignore

    def _ends_run(self, stage: Stage) -> bool:
        """Say whether a message that ends its topic ends the run with it."""
        if stage is Stage.DECODE and self.on_message_error is LoaderErrorPolicy.RAISE:
            return True
        return self.plan.on_error is TopicLevelErrorPolicy.Raise

    def _end(self, fatal: _Lost, batch: MessageBlock, end: int) -> None:
        """Apply the policy a lost message has triggered."""
        kind = DecodeError if fatal.stage is Stage.DECODE else AdapterError
        offset = int(batch.offsets[fatal.failure.row])
        error = kind(fatal.failure.reason, where=f"{self.plan.topic} at offset {offset}")
        self.error = str(error)
        self.session.note_error(self.error, topic=self.plan.target)
        if self._ends_run(fatal.stage):
            raise error
        self.status = TopicStatus.FINALIZED
        self._count_rest(batch, end)

    def _count_rest(self, batch: MessageBlock, end: int) -> None:
        rest = batch.lengths[end:]
        if len(rest):
            self.observe(TopicProgress(self.plan.target, read=len(rest), payload_bytes=int(rest.sum())))
            self._reject_rest(batch, end)

    def _reject_rest(self, batch: MessageBlock, start: int) -> None:
        self.observe(
            Rejected(
                self.plan.target,
                Stage.WRITE,
                "topic-closed",
                len(batch) - start,
                f"the topic was closed: {self.error}",
                int(batch.log_times[start]),
                int(batch.offsets[start]),
            )
        )

    def _write(
        self, rows: pa.RecordBatch, batch: MessageBlock, index: NDArray[np.int64], buffer: WriteBuffer
    ) -> None:
        if self._writer is None:
            try:
                metadata = {**(self._configuration or {}), **self.plan.metadata}
                self._writer = self.session.topic(self.plan.target, self.plan.ontology, metadata)
            except SinkError as error:
                self._refused(error, rows, batch, index)
                return
        times = rows.column(0).to_numpy()
        first, last = int(times.min()), int(times.max())
        self.timeline.add(times)
        self.rows += rows.num_rows
        self.start_ns = first if self.start_ns is None else min(self.start_ns, first)
        self.end_ns = last if self.end_ns is None else max(self.end_ns, last)
        self.status = TopicStatus.WRITTEN
        # Counted before they are handed over, where a run may end: what is not stored then is taken back.
        self.observe(TopicProgress(self.plan.target, written=rows.num_rows, start_ns=first, end_ns=last))
        self.watch.lap(Step.ADAPT)
        buffer.put(self._writer, rows)
        self.watch.lap(Step.WAIT)

    def _refused(
        self, error: IngestError, rows: pa.RecordBatch, batch: MessageBlock, index: NDArray[np.int64]
    ) -> None:
        """Give the topic up, or the run, as its policy says."""
        self.status, self.error = TopicStatus.FAILED, str(error)
        first = int(index[0])
        self.observe(
            Rejected(
                self.plan.target,
                Stage.WRITE,
                "topic-refused",
                rows.num_rows,
                self.error,
                int(batch.log_times[first]),
                int(batch.offsets[first]),
            )
        )
        if self.plan.on_error is TopicLevelErrorPolicy.Raise:
            raise error

    def _count(self, batch: MessageBlock, end: int, *, downsampled: int = 0) -> None:
        self.observe(
            TopicProgress(
                self.plan.target,
                read=end,
                downsampled=downsampled,
                payload_bytes=int(batch.lengths[:end].sum()),
            )
        )

    def _reject(self, batch: MessageBlock, lost: Iterable[_Lost], quarantined: set[int]) -> None:
        """Say what was lost, once for each rule, with the first message as the example."""
        groups: dict[tuple[Stage, str], list[RowFailure]] = {}
        for one in lost:
            groups.setdefault((one.stage, one.failure.rule), []).append(one.failure)
        for (stage, rule), failures in groups.items():
            first = failures[0]
            self.observe(
                Rejected(
                    self.plan.target,
                    stage,
                    rule,
                    len(failures),
                    first.reason,
                    int(batch.log_times[first.row]),
                    int(batch.offsets[first.row]),
                    sum(failure.row in quarantined for failure in failures),
                )
            )


@cache_by_identity
def _columns(ontology: OntologyType) -> _Columns:
    return _Columns(ontology.struct)


class _Columns:
    """The columns of a topic's batches; what their type alone decides is found once."""

    def __init__(self, kind: pa.StructType) -> None:
        self.kind = kind
        self._schema = pa.schema([ENVELOPE, *kind])
        self._required = RequiredFields(kind)

    def batch(self, log_times: NDArray[np.int64], rows: pa.StructArray) -> pa.RecordBatch:
        """Put the time stamps before the ontology's columns."""
        if rows.type != self.kind:  # the destination will say what is wrong with them
            return _Columns(rows.type).batch(log_times, rows)
        columns = self._required.fill(rows).flatten()
        return pa.RecordBatch.from_arrays([pa.array(log_times), *columns], schema=self._schema)
