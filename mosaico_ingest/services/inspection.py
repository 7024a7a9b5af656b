"""Inspection of a recording: its index, definitions and adapters."""

from __future__ import annotations

import re

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.display import bytes_text, count_text, counted, mean_rate_hz, rate_text
from mosaico_ingest.documents import Part, html_table
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import one_line
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import select
from mosaico_ingest.pipeline.plan import ExcludedTopic
from mosaico_ingest.pipeline.planning import plan_connection
from mosaico_ingest.pipeline.task import open_job
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import Connection, Int64s
from mosaico_ingest.rosbag.recording import Recording

_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")


class InspectedTopic(Part):
    """One topic of the recording, with the adapter it would get."""

    topic: str
    msgtype: str
    encoding: str
    count: int | None
    """Number of messages in the index; None if it is unknown."""
    rate_hz: float | None
    """Messages per second; see `mean_rate_hz`, and `estimate_rate_hz` for recordings whose index has no times."""
    definition: str
    """The source of the definition: bag, custom, distro, package or none."""
    adapter: str
    """The adapter of the topic without a manifest; empty if the topic cannot be ingested."""
    ontology: str | None
    """The ontology tag of the rows; None if the topic cannot be ingested."""
    problem: str | None = None
    """The reason why the topic cannot be ingested."""


class Inspection(Part):
    """The content of a recording according to its index."""

    files: tuple[str, ...]
    container: str
    size_bytes: int
    messages: int | None
    start_ns: int | None
    end_ns: int | None
    topics: tuple[InspectedTopic, ...]
    findings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return the counts, such as `<Inspection drive.mcap: 9 topics, 2,110 messages, 497.3 kB>`."""
        messages = "? messages" if self.messages is None else counted(self.messages, "message")
        facts = f"{counted(len(self.topics), 'topic')}, {messages}, {bytes_text(self.size_bytes)}"
        return one_line(f"<Inspection {', '.join(self.files)}: {facts}>")

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        rows = (
            (
                topic.topic,
                topic.msgtype,
                "?" if topic.count is None else count_text(topic.count),
                rate_text(topic.rate_hz),
                topic.ontology or topic.problem or "-",
            )
            for topic in self.topics
        )
        names = ("topic", "type", "messages", "rate", "becomes")
        caption, numbers = repr(self)[1:-1], {"messages", "rate"}
        return html_table(caption, names, rows, count=len(self.topics), numbers=numbers, notes=self.findings)

    @property
    def duration_s(self) -> float | None:
        """Seconds from the first message to the last."""
        if self.start_ns is None or self.end_ns is None:
            return None
        return (self.end_ns - self.start_ns) / 1e9


def inspect(job: Job) -> Inspection:
    """Open a recording and return its content.

    Raises:
        BagError: The recording cannot be opened.
    """
    bridge = ROSBridge.for_job(job)
    with open_job(job) as (recording, _):
        rates = _rates(recording)
        topics = [_topic(job, one, bridge, rates[one.id]) for one in recording.connections]
        return Inspection(
            files=tuple(str(path) for path in recording.files),
            container=recording.container,
            size_bytes=recording.size_bytes,
            messages=recording.message_count,
            start_ns=recording.start_ns,
            end_ns=recording.end_ns,
            topics=tuple(sorted(topics, key=lambda topic: topic.topic)),
            findings=tuple(str(finding) for finding in recording.findings),
        )


def _topic(job: Job, connection: Connection, bridge: ROSBridge, rate_hz: float | None) -> InspectedTopic:
    try:
        outcome = plan_connection(job, connection, select((), [connection.topic]), bridge, "")
    except AdapterError as error:
        outcome = ExcludedTopic(
            topic=connection.topic, msgtype=connection.msgtype, count=connection.count, why=str(error)
        )
    source = connection.definition.source.value if connection.definition else "none"
    return InspectedTopic(
        topic=connection.topic,
        msgtype=connection.msgtype,
        encoding=connection.encoding.value,
        count=connection.count,
        rate_hz=rate_hz,
        definition=source,
        adapter="" if isinstance(outcome, ExcludedTopic) else ", ".join(one.adapter.name for one in outcome),
        ontology=None
        if isinstance(outcome, ExcludedTopic)
        else ", ".join(one.ontology.tag for one in outcome),
        problem=outcome.why if isinstance(outcome, ExcludedTopic) else None,
    )


def _rates(recording: Recording) -> dict[int, float | None]:
    """Return the rate of each connection according to the index, without reading messages."""
    connections = recording.connections
    # The times of a remote file cost a request per chunk.
    times = None if recording.is_remote else recording.index_times([one.id for one in connections])
    if times is not None:
        return {key: mean_rate_hz(len(one), *_ends(one)) for key, one in times.items()}
    rates = dict[int, float | None].fromkeys(one.id for one in connections)
    if recording.start_ns is not None and recording.end_ns is not None:
        duration_ns = recording.end_ns - recording.start_ns
        for one in connections:
            if one.count is not None and one.count > 1 and duration_ns > 0:
                rates[one.id] = estimate_rate_hz(one.count, duration_ns)
    return rates


def _ends(times: Int64s) -> tuple[int | None, int | None]:
    return (int(times[0]), int(times[-1])) if len(times) else (None, None)


def estimate_rate_hz(count: int, duration_ns: int) -> float:
    """Return the roundest rate with which `count` messages, at least two, fit the duration of the recording.

    The estimate is for recordings whose index has no times per topic, and assumes that the topic covers the complete
    recording. A regular topic with n messages in d seconds has a rate between (n - 1) / d and n / d, so only the digits
    that both bounds share are known.
    """
    low, high = (count - 1) * 1e9 / duration_ns, count * 1e9 / duration_ns
    middle = (low + high) / 2
    candidates = (round(middle, decimals) for decimals in range(10))
    return next((rate for rate in candidates if low <= rate <= high), middle)


def default_name(recording: AnyPath) -> str:
    """Return the stem of a recording's file name, with `_` for characters that sequence names cannot contain."""
    name = recording.name if isinstance(recording, RemotePath) else recording.resolve().name
    stem = re.sub(r"\.(bag|db3|mcap)(\.\w+)?$", "", name, flags=re.IGNORECASE)
    name = _REFUSED.sub("_", stem).strip("_-")
    return name if name[:1].isalnum() else f"drive_{name}".rstrip("_")
