"""This file is what `ingest inspect` finds in a recording."""

from __future__ import annotations

from mosaico_ingest.report.part import Part

__all__ = ["InspectedTopic", "Inspection"]


class InspectedTopic(Part):
    """One topic of the recording and what it would become."""

    topic: str
    msgtype: str
    encoding: str
    count: int | None
    """How many messages the index promises."""
    rate_hz: float | None
    """Messages a second over the recording's span."""
    definition: str
    """Where the definition was found: bag, custom, distro, package or none."""
    adapter: str
    """The adapter it would get."""
    ontology: str | None
    """The ontology tag it would have; None where it cannot be ingested."""
    problem: str | None = None
    """Why it cannot be ingested."""


class Inspection(Part):
    """A recording as its index describes it."""

    files: tuple[str, ...]
    container: str
    size_bytes: int
    messages: int | None
    start_ns: int | None
    end_ns: int | None
    topics: tuple[InspectedTopic, ...]
    findings: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float | None:
        """Seconds from the first message to the last."""
        if self.start_ns is None or self.end_ns is None:
            return None
        return (self.end_ns - self.start_ns) / 1e9
