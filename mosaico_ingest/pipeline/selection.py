"""The times of a topic's rows, and which decoded messages of a topic become rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.decode.base import Decoder
from mosaico_ingest.job.values import StampSource
from mosaico_ingest.pipeline.plan import Plan, TopicPlan
from mosaico_ingest.rosbag.blocks import MessageBlock

if TYPE_CHECKING:
    from mosaico_ingest.pipeline.conditions import ConditionFilter, Conditions

Int64s = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SECOND_NS = 1_000_000_000


class RowTimes(Struct, frozen=True):
    """The times of some decoded messages."""

    values: Int64s
    """Nanoseconds since the epoch, shape (n,)."""
    fallback: Mask | None = None
    """Where a message has no selected time, and therefore its log time; None if all messages have it."""


def row_times(
    stamp: StampSource,
    offset_ns: int,
    rows: pa.StructArray,
    log_times: Int64s,
    publish_times: Int64s | None,
) -> RowTimes:
    """Return the times of decoded messages, according to `stamp` and `time_offset`.

    Without `publish_times`, publish times equal the log times.
    """
    times = RowTimes(log_times)
    if stamp is StampSource.PUBLISH and publish_times is not None:
        times = _or_log_times(publish_times, log_times)
    elif stamp is StampSource.HEADER:
        from mosaico_ingest.contracts.rows import stamps_of  # noqa: PLC0415 - only header stamps need it

        times = _or_log_times(stamps_of(rows), log_times)
    if offset_ns:
        return RowTimes(times.values + offset_ns, times.fallback)
    return times


def block_times(block: MessageBlock, decoder: Decoder, stamp: StampSource, offset_ns: int) -> Int64s:
    """Return the time of every message of a block, shape (n,); a message that cannot be decoded has its log time."""
    if stamp is StampSource.LOG:
        return block.log_times + offset_ns
    if stamp is StampSource.PUBLISH:
        no_rows = pa.StructArray.from_arrays([], names=[])
        return row_times(stamp, offset_ns, no_rows, block.log_times, block.publish_times).values
    decoded = decoder.decode(block)
    times = block.log_times + offset_ns
    index = decoded.index
    times[index] = row_times(stamp, offset_ns, decoded.rows, block.log_times[index], None).values
    return times


def _or_log_times(stamps: Int64s | None, log_times: Int64s) -> RowTimes:
    """Return the stamps, and the log time in place of each zero stamp."""
    if stamps is None:
        return RowTimes(log_times, np.ones(len(log_times), bool))
    missing = stamps == 0
    return RowTimes(np.where(missing, log_times, stamps), missing if missing.any() else None)


def row_selector(plan: Plan, topic: TopicPlan) -> RowSelector | None:
    """Return the selector of a topic, or None if it keeps all rows."""
    if plan.selects_after_reading:
        return RowSelector(topic, plan.read_from_ns, plan.read_until_ns)
    return RowSelector(topic) if topic.rate is not None or topic.has_conditions else None


@dataclass(slots=True)
class RowSelector:
    """Selects the rows of one topic by time range, conditions and rate; its state spans all blocks of the topic."""

    plan: TopicPlan
    start_ns: int | None = None
    """Earlier rows are dropped; None if the reader has applied the time range already."""
    end_ns: int | None = None
    """Rows of this time or later are dropped."""
    _filter: ConditionFilter | None = None
    _origin_ns: int | None = None
    _last_interval: int = -1

    def select(
        self, times: Int64s, rows: pa.StructArray, envelope: Envelope, conditions: Conditions | None
    ) -> tuple[Mask | None, Mapping[str, Mask]]:
        """Return the rows to keep, or None for all of them, and the rows that each rule drops.

        A row counts for the first rule that drops it.
        """
        keep = np.ones(len(times), bool)
        dropped: dict[str, Mask] = {}
        if self.start_ns is not None or self.end_ns is not None:
            start = times.min(initial=0) if self.start_ns is None else self.start_ns
            inside = times >= start if self.end_ns is None else (times >= start) & (times < self.end_ns)
            dropped["time_range"] = keep & ~inside
            keep &= inside
        if conditions is not None:
            if self._filter is None:
                from mosaico_ingest.pipeline.conditions import ConditionFilter  # noqa: PLC0415 - only conditions need it

                self._filter = ConditionFilter()
            remaining = rows if keep.all() else rows.filter(pa.array(keep))
            where, on_change = (
                _scattered(mask, keep)
                for mask in self._filter.select(conditions, remaining, envelope.take(keep))
            )
            dropped |= {"where": keep & ~where, "on_change": where & ~on_change}
            keep = on_change
        if self.plan.rate is not None:
            selected = _scattered(self._first_of_intervals(times[keep], self.plan.rate), keep)
            dropped["rate"] = keep & ~selected
            keep = selected
        return (None, {}) if keep.all() else (keep, dropped)

    def _first_of_intervals(self, times: Int64s, rate: float) -> Mask:
        """Return the rows whose interval is later than that of every earlier row."""
        if not len(times):
            return np.zeros(0, bool)
        if self._origin_ns is None:
            self._origin_ns = int(times[0])
        intervals = np.floor_divide(times - self._origin_ns, _SECOND_NS / rate).astype(np.int64)
        latest = np.maximum.accumulate(np.concatenate(([self._last_interval], intervals)))
        self._last_interval = int(latest[-1])
        return intervals > latest[:-1]


def _scattered(mask: Mask, rows: Mask) -> Mask:
    """Return a mask over all rows from a mask over some rows."""
    result = np.zeros(len(rows), bool)
    result[rows] = mask
    return result
