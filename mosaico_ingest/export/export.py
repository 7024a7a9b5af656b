"""This file writes a sequence back: it reads its topics side by side and writes their messages by time."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from pathlib import Path

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.reference import adapter_spec
from mosaico_ingest.bag.writing import RecordingWriter, open_writer
from mosaico_ingest.bag.writing.opening import ROS_VERSIONS
from mosaico_ingest.diagnostics import offered
from mosaico_ingest.errors import AdapterError, BagError, NothingMatched
from mosaico_ingest.export.account import ExportReport, TopicExport
from mosaico_ingest.export.origin import origin_of, version_of
from mosaico_ingest.export.restore import Restorer, restorer_for
from mosaico_ingest.patterns import select
from mosaico_ingest.store import SequenceInfo, Store, TopicInfo

__all__ = ["export_sequence"]


def export_sequence(
    store: Store,
    sequence: str,
    path: Path | str,
    *,
    topics: Sequence[str] = (),
    start_ns: int | None = None,
    end_ns: int | None = None,
    adapters: Sequence[str] = (),
    replace: bool = False,
) -> ExportReport:
    """Write a sequence, or what patterns and a span of time select of it, to a recording; return the account.

    The file's suffix says which kind: `.mcap`, `.db3` (ROS 2) or `.bag` (ROS 1). `start_ns` is in, `end_ns` is not.

    Raises:
        NothingMatched: No topic is selected, or none can be written.
        BagError: The file is there already, or cannot be written.
        SinkError: There is no such sequence, or it cannot be read.
        AdapterError: One of `adapters` is none.
    """
    path = Path(path)
    found = store.sequence(sequence)
    chosen = _selected(found, topics)
    specs = [adapter_spec(reference, Path()) for reference in adapters]
    with open_writer(path, replace=replace) as writer:
        restorers: list[tuple[int, Restorer]] = []
        left: list[TopicExport] = []
        for info in chosen:
            outcome = _prepare(info, chosen, specs, path.suffix, writer)
            if isinstance(outcome, TopicExport):
                left.append(outcome)
            else:
                restorers.append(outcome)
        if not restorers:
            raise NothingMatched(
                f"none of {len(left)} topics can be written", where=sequence, hint=_first(left)
            )
        streams = [_stream(store, channel, restorer, start_ns, end_ns) for channel, restorer in restorers]
        for log_ns, channel, payload in heapq.merge(*streams, key=lambda message: message[0]):
            writer.write(channel, log_ns, payload)
        if not any(restorer.messages for _, restorer in restorers):
            raise NothingMatched(
                "there is no message to write", where=sequence, hint="look at --start and --end"
            )
    accounts = [*(restorer.account() for _, restorer in restorers), *left]
    accounts.sort(key=lambda one: one.topic)
    return ExportReport(sequence=sequence, path=str(path), bytes=path.stat().st_size, topics=tuple(accounts))


def _selected(found: SequenceInfo, patterns: Sequence[str]) -> tuple[TopicInfo, ...]:
    names = [topic.name for topic in found.topics]
    selection = select(patterns, names)
    if not selection.selected:
        what = f"no topic matches {', '.join(map(repr, patterns))}" if names else "the sequence has no topic"
        raise NothingMatched(what, where=found.name, hint=offered(names, patterns) if names else None)
    return tuple(topic for topic in found.topics if topic.name in selection.selected)


def _prepare(
    info: TopicInfo,
    chosen: Sequence[TopicInfo],
    specs: Sequence[AdapterSpec],
    suffix: str,
    writer: RecordingWriter,
) -> tuple[int, Restorer] | TopicExport:
    """Open the channel of a topic, or say why it cannot be."""
    origin = origin_of(info)
    if origin is None:
        return _left(info, "", "its metadata does not say which messages it was made of")
    others = [other for topic in chosen if (other := origin_of(topic)) is not None]
    version = version_of(origin, others, ROS_VERSIONS[suffix])
    try:
        restorer = restorer_for(info, origin.definition(version), specs)
        return writer.channel(info.name, restorer.definition), restorer
    except (AdapterError, BagError) as error:
        return _left(info, origin.msgtype, f"{error.what} — {error.hint}" if error.hint else error.what)


def _left(info: TopicInfo, msgtype: str, why: str) -> TopicExport:
    return TopicExport(topic=info.name, msgtype=msgtype, ontology=info.ontology.tag, left_out=why)


def _first(left: Sequence[TopicExport]) -> str:
    return f"{left[0].topic}: {left[0].left_out}"


def _stream(
    store: Store, channel: int, restorer: Restorer, start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[int, int, bytes]]:
    info = restorer.info
    with store.scan(info.sequence, info.name, start_ns=start_ns, end_ns=end_ns) as reader:
        for log_ns, payload in restorer.read(iter(reader)):
            yield log_ns, channel, payload
