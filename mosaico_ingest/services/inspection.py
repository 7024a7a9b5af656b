"""Inspection of a recording: its index, definitions and adapters, and the draft of a manifest that ingests it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from glob import escape
from os.path import relpath
from pathlib import Path

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.display import bytes_text, count_text, counted, mean_rate_hz, rate_text, seconds_text
from mosaico_ingest.documents import Part, html_table
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import one_line
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.reference import plain
from mosaico_ingest.job.values import Stores, select
from mosaico_ingest.pipeline.plan import ExcludedTopic
from mosaico_ingest.pipeline.planning import plan_connection
from mosaico_ingest.pipeline.task import open_job
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import Connection, Encoding, Int64s
from mosaico_ingest.rosbag.definitions.model import Source
from mosaico_ingest.rosbag.definitions.registry import ROS2, distro_type
from mosaico_ingest.rosbag.recording import Recording

_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")
_HEAD = (
    "# yaml-language-server: $schema=job.schema.json",
    "# `ingest schema job --write .` writes that schema, for completion and hover in an editor.",
)


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


def draft_manifest(
    inspection: Inspection, recording: AnyPath, *, folder: Path, ros_distro: Stores | str | None = None
) -> str:
    """Return a manifest of `recording` for a file in `folder`; it has no lint findings and can be run unchanged."""
    return "\n".join(
        (
            *_HEAD,
            "version: 1",
            "",
            *_bag(inspection, _path_from(folder, recording), ros_distro),
            "",
            "sequence:",
            f"  name: {plain(default_name(recording))}",
            "  # metadata: {vehicle: demo-01}",
            "  # if_exists: replace                # fail, skip, append or replace",
            "",
            *_topics(inspection),
            "",
            *_adapters(inspection),
            "",
            "on_error:",
            "  message: log_warn                   # messages that cannot be decoded: ignore, log_warn, raise",
            "  topic: raise                        # rejected rows: raise, ignore, finalize",
            "  session: report                     # after an error that ends the run: report, delete",
            "",
            "target: {store: mosaico}",
            '# target: {host: mosaico.example.org, api_key: "${MOSAICO_API_KEY}", tls: true}',
            "",
        )
    )


def default_name(recording: AnyPath) -> str:
    """Return the stem of a recording's file name, with `_` for characters that sequence names cannot contain."""
    name = recording.name if isinstance(recording, RemotePath) else recording.resolve().name
    stem = re.sub(r"\.(bag|db3|mcap)(\.\w+)?$", "", name, flags=re.IGNORECASE)
    name = _REFUSED.sub("_", stem).strip("_-")
    return name if name[:1].isalnum() else f"drive_{name}".rstrip("_")


def _bag(inspection: Inspection, path: str, ros_distro: Stores | str | None) -> Iterator[str]:
    span = "" if inspection.duration_s is None else f", {seconds_text(inspection.duration_s)}"
    messages = "" if inspection.messages is None else f", {counted(inspection.messages, 'message')}"
    ours = [topic for topic in inspection.topics if topic.encoding != Encoding.OTHER.value]
    undefined = sorted({topic.msgtype for topic in ours if topic.definition == "none"})
    yield f"# {inspection.container}, {bytes_text(inspection.size_bytes)}{messages}{span}"
    yield "bag:"
    silenced = path.lower().endswith(".db3") and ros_distro is None and not undefined
    mark = f"  # ingest: ignore[distro-missing] ({_known_from(ours)})" if silenced else ""
    yield f"  path: {plain(path)}{mark}"
    if ros_distro is not None:
        yield f"  ros_distro: {Stores(ros_distro).value}"
    yield from _definitions(undefined, ros_distro)


def _definitions(undefined: Sequence[str], ros_distro: Stores | str | None) -> Iterator[str]:
    """Yield comments on types without a definition, and on types that differ between distros."""
    standard = [name for name in undefined if any(distro_type(distro, name) for distro in ROS2)]
    if standard and ros_distro is None:
        yield f"  # {', '.join(standard)} differs between distros, and the recording does not define it; set the distro:"
        yield "  # ros_distro: ros2_humble"
    own = [name for name in undefined if ros_distro is not None or name not in standard]
    if own:
        yield f"  # no definition found for {', '.join(own)}; name the folder of the .msg files:"
        for package in dict.fromkeys(msgtype.partition("/")[0] for msgtype in own):
            yield f"  # custom_msgs: [{{package: {package}, path: definitions/{package}}}]"


def _known_from(topics: Sequence[InspectedTopic]) -> str:
    assumed = sorted({topic.definition for topic in topics} - {Source.BAG.value})
    phrases = {Source.DISTRO.value: "as in all distros", Source.PACKAGE.value: "as in public packages"}
    how = " or ".join(phrases[source] for source in assumed)
    return f"it contains no definitions; they are read {how}" if assumed else "it contains its definitions"


def _topics(inspection: Inspection) -> Iterator[str]:
    """Yield the topics as a list in which a # excludes a topic; topics that cannot be ingested are excluded."""
    topics = _merged(inspection.topics)
    good = [topic for topic in topics if topic.problem is None]
    width = min(44, max((len(_quoted(topic.topic)) for topic in topics), default=0))
    yield "# Put a # before a topic to exclude it. Globs work too: the last match decides, a leading ! excludes."
    yield '# Quote names that start with * or !: ["/cam*", "!/cam/debug*"].'
    if any(not topic.topic.startswith("/") for topic in good):
        yield "# ingest: ignore-file[relative-topic] (the recording uses these names)"
    yield "topics:" if good else "# topics:"
    for topic in good:
        yield f"  - {_quoted(topic.topic):{width}}  # {_about(topic)}"
    for topic in topics:
        if topic.problem is not None:
            yield f"  # - {_quoted(topic.topic):{width}}  # {topic.msgtype}: {_one_line(topic.problem)}"


def _adapters(inspection: Inspection) -> Iterator[str]:
    unmodeled = [topic for topic in _merged(inspection.topics) if topic.adapter == UnmodeledSpec().name]
    if unmodeled:
        yield f"# No adapter accepts {', '.join(sorted({topic.msgtype for topic in unmodeled}))}: their messages keep their shape."
    yield "adapters:"
    yield "  unmodeled: keep                     # a type without an adapter: keep, skip, fail"
    yield "  # load: [adapters/mine.yaml]        # your adapters, for every topic of their types"
    example = (
        unmodeled[0].topic if unmodeled else inspection.topics[0].topic if inspection.topics else "/topic"
    )
    offers = [
        (topic, adapter) for topic in unmodeled for adapter in BUILTIN if topic.msgtype in adapter.ros_types
    ]
    for topic, adapter in offers:
        yield f"  # {adapter.name} accepts {topic.msgtype} only if an override selects it, and stores {adapter.tag}:"
        yield f"  # override: {{{plain(topic.topic)}: {adapter.name}}}"
    if not offers:
        yield f"  # override: {{{plain(example)}: MyAdapter}}"


def _merged(topics: Sequence[InspectedTopic]) -> list[InspectedTopic]:
    """Return one entry per topic; prefer a connection that can be ingested."""
    best: dict[str, InspectedTopic] = {}
    for topic in topics:
        previous = best.get(topic.topic)
        if previous is None or (previous.problem is not None and topic.problem is None):
            best[topic.topic] = topic
    return list(best.values())


def _about(topic: InspectedTopic) -> str:
    count = "?" if topic.count is None else str(topic.count)
    rate = "" if topic.rate_hz is None else f" at {topic.rate_hz:.1f} Hz"
    return f"{count} x {topic.msgtype}{rate}, {topic.ontology} by {topic.adapter}"


def _quoted(topic: str) -> str:
    return plain(escape(topic))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _path_from(folder: Path, path: AnyPath) -> str:
    return path.url if isinstance(path, RemotePath) else Path(relpath(path, folder)).as_posix()
