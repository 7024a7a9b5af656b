"""This file says what is odd about a recording: what its metadata claim, what its topics mix, what is skipped."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

from mosaico_ingest.bag.batch import Channel, Encoding, Loss
from mosaico_ingest.bag.containers.part import Part
from mosaico_ingest.bag.metadata import Metadata, TopicHint
from mosaico_ingest.diagnostics import Finding, Severity

__all__ = ["compare"]


def compare(
    parts: Sequence[Part], channels: Sequence[Channel], losses: Sequence[Loss], metadata: Metadata | None
) -> tuple[Finding, ...]:
    """Return what a reader of this recording should know, most of it harmless."""
    hints = _metadata(channels, metadata) if metadata else ()
    return (*_parts(parts), *_losses(losses), *_channels(channels), *hints)


def _parts(parts: Sequence[Part]) -> Iterator[Finding]:
    for part in parts:
        for note in part.notes:
            yield Finding("container-note", Severity.INFO, f"{part.path}: {note}")


def _losses(losses: Sequence[Loss]) -> Iterator[Finding]:
    for loss in losses:
        yield Finding("damaged", Severity.WARNING, f"{loss.file}: at {loss.offset}: {loss.reason}")


def _channels(channels: Sequence[Channel]) -> Iterator[Finding]:
    types: dict[str, set[str]] = defaultdict(set)
    for channel in channels:
        types[channel.topic].add(channel.msgtype)
        if channel.encoding is Encoding.OTHER:
            yield Finding(
                "skipped-encoding", Severity.WARNING, f"{channel.topic} is skipped: {channel.problem}"
            )
    for topic, names in types.items():
        if len(names) > 1:
            listed = ", ".join(sorted(names))
            yield Finding(
                "two-types", Severity.WARNING, f"{topic} has messages of {len(names)} types: {listed}"
            )


def _metadata(channels: Sequence[Channel], metadata: Metadata) -> Iterator[Finding]:
    stored: dict[str, list[Channel]] = defaultdict(list)
    for channel in channels:
        stored[channel.topic].append(channel)
    for hint in metadata.topics:
        for difference in _differences(hint, stored.pop(hint.topic, [])):
            yield _differs(metadata, f"{hint.topic}: {difference}")
    for topic, found in stored.items():
        if any(channel.count != 0 for channel in found):
            yield _differs(metadata, f"{topic} is not in the metadata")


def _differences(hint: TopicHint, channels: Sequence[Channel]) -> Iterator[str]:
    if not channels:
        if hint.count:
            yield f"{hint.count} messages in the metadata, no such topic in the storage"
        return
    names = {channel.msgtype for channel in channels}
    if {name.replace("/msg/", "/") for name in names} != {hint.msgtype.replace("/msg/", "/")}:
        yield f"type {hint.msgtype} in the metadata, {', '.join(sorted(names))} in the storage"
    counts = [channel.count for channel in channels]
    total = sum(count or 0 for count in counts)
    if None not in counts and total != hint.count:
        yield f"{hint.count} messages in the metadata, {total} in the storage"
    first = channels[0].attributes
    if hint.qos and first.get("offered_qos_profiles", hint.qos).strip() != hint.qos.strip():
        yield "the QoS in the metadata is not that in the storage"
    encoding = first.get("encoding", "")
    if hint.serialization_format and encoding and hint.serialization_format != encoding:
        yield f"serialisation {hint.serialization_format} in the metadata, {encoding} in the storage"


def _differs(metadata: Metadata, difference: str) -> Finding:
    return Finding(
        "metadata-differs",
        Severity.INFO,
        f"{metadata.path}: {difference}",
        help="the storage decides what is read",
    )
