"""The draft of a manifest that ingests an inspected recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from glob import escape
from os.path import relpath
from pathlib import Path

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.display import bytes_text, counted, seconds_text
from mosaico_ingest.job.reference import plain
from mosaico_ingest.job.values import Stores
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import Source
from mosaico_ingest.rosbag.definitions.registry import ROS2, distro_type
from mosaico_ingest.services.inspection import InspectedTopic, Inspection, default_name

_HEAD = (
    "# yaml-language-server: $schema=job.schema.json",
    "# `ingest schema job --write .` writes that schema, for completion and hover in an editor.",
)


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
