"""The page of a sequence, with programs that read it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store import SequenceInfo, Store, TopicInfo
from mosaico_ingest.display import bytes_text, count_text, interval_text, rate_text, seconds_text, time_text
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.values import ATTACHMENTS_KEY, PROVENANCE_KEY
from mosaico_ingest.pages.design import Axis, Track, draw_track, optional_span, render, time_axis
from mosaico_ingest.pages.drawings import (
    Map,
    Strip,
    TopicPlots,
    draw_map,
    picture_strip,
    plotted_columns,
    topic_plots,
)
from mosaico_ingest.version import __version__
from mosaico_ingest.view.columns import TopicStatistics, describe_topic
from mosaico_ingest.view.pictures import has_images, has_pictures
from mosaico_ingest.view.texts import ColumnTexts, LogExcerpt, column_texts, has_log, read_excerpt
from mosaico_ingest.view.tracks import Track as Positions
from mosaico_ingest.view.tracks import frame_trees, has_track, read_edges, read_track

MAX_STRIPS = 24
"""Topics with pictures that a page shows."""
MAX_TOPICS = 300
"""Topics whose values a page describes."""
_Value = TypeVar("_Value")


def sequence_page(
    store: Store, name: str, *, list_link: str | None = None, runs_link: str | None = None
) -> str:
    """Return the page of a sequence; a web server passes the addresses of its lists of sequences and of runs.

    Raises:
        SinkError: The sequence does not exist. Topics that cannot be read are described as problems on the page.
    """
    info = store.sequence(name)
    return render(
        "sequence.html",
        has_plots=True,
        **_Content(store, info).values(),
        list_link=list_link,
        runs_link=runs_link,
    )


class Snippet(Struct, frozen=True):
    """A program with its title."""

    title: str
    code: str


def sequence_snippets(store: Store, info: SequenceInfo) -> list[Snippet]:
    """Return programs for the topic with the most rows, of those with numbers if there are any; none without rows."""
    topics = [topic for topic in info.topics if topic.segments]
    if not topics:
        return []
    topic = max(topics, key=lambda each: (bool(plotted_columns(each)), each.rows))
    path, steps = str(store.path), _column(topic)
    files = f"{topic.segments[0].path.parent}/*.parquet"
    quoted = ".".join('"' + step.replace('"', '""') + '"' for step in steps)
    sql = f"SELECT timestamp_ns, {quoted} FROM '{files.replace(chr(39), chr(39) * 2)}' ORDER BY timestamp_ns"  # noqa: S608 - shown, not executed
    fields = "".join(f".struct.field({step!r})" for step in steps[1:])
    return [
        Snippet("DuckDB", f"import duckdb\n\nduckdb.sql({sql!r}).show()"),
        Snippet(
            "Polars",
            "import polars as pl\n\n"
            f"frame = pl.scan_parquet({files!r})\n"
            f'print(frame.select("timestamp_ns", pl.col({steps[0]!r}){fields}).collect())',
        ),
        Snippet(
            "Python",
            "from mosaico_ingest import Store\n\n"
            f"topic = Store.open({path!r}, create=False).sequence({info.name!r}).topic({topic.name!r})\n"
            f"print(topic.to_arrow(columns=[{'.'.join(steps)!r}]))",
        ),
        Snippet(
            "Official SDK (mosaicolabs)",
            f"# in another terminal: ingest serve --store {shlex.quote(path)}\n"
            "from mosaicolabs import MosaicoClient\n\n"
            'with MosaicoClient.connect("127.0.0.1", 6726) as client:\n'
            f"    topic = client.sequence_handler({info.name!r}).get_topic_handler({topic.name!r})\n"
            "    for message in topic.get_data_streamer():\n"
            "        print(message.timestamp_ns, message.data)",
        ),
        Snippet(
            "Command line",
            f"ingest store show {shlex.quote(info.name + topic.name)} --store {shlex.quote(path)}",
        ),
    ]


class _TopicView(Struct, frozen=True):
    """One topic on the page."""

    info: TopicInfo
    timing: str
    """The rate."""
    jitter: str
    gap_count: int
    track: Track | None
    columns: tuple[ColumnTexts, ...]


class _Content:
    """The values of the page, with the problems that occurred while they were computed."""

    def __init__(self, store: Store, info: SequenceInfo) -> None:
        self._store, self._info = store, info
        self._problems: list[str] = []
        self._fixed: list[str] = []
        self._topics = info.topics[:MAX_TOPICS]
        self._axis = time_axis(
            time for topic in info.topics for time in (topic.start_ns, topic.end_ns) if time is not None
        )

    def values(self) -> dict[str, Any]:
        """Return the variables of the template."""
        info = self._info
        described = {topic.name: self._attempt(topic, describe_topic) for topic in self._topics}
        strips = list(self._strips())
        edges = self._attempt(None, lambda _: read_edges(self._topics)) or []
        return {
            "info": info,
            "version": __version__,
            "facts": _facts(info),
            "axis": self._axis,
            "topics": [_topic_view(topic, described[topic.name], self._axis) for topic in self._topics],
            "omitted_topics": len(info.topics) - len(self._topics),
            "cameras": [strip for topic, strip in strips if has_images(topic.schema)],
            "clouds": [strip for topic, strip in strips if not has_images(topic.schema)],
            "maps": list(self._maps()),
            "fixed": self._fixed,
            "plots": list(self._plots(described)),
            "frames": frame_trees(edges),
            "frame_count": len({name for edge in edges for name in (edge.parent, edge.child)}),
            "logs": list(self._logs()),
            "metadata": dict(_flatten(info.metadata)),
            "sources": list(_sources(info)),
            "sessions": info.sessions,
            "snippets": sequence_snippets(self._store, info),
            "problems": self._problems,
        }

    def _attempt(self, topic: TopicInfo | None, read: Callable[[Any], _Value]) -> _Value | None:
        """Return what `read` returns for a topic; describe the problem if its files cannot be read."""
        try:
            return read(topic)
        except (IngestError, OSError, pa.ArrowException) as error:
            name = f"{topic.name}: " if topic else ""
            text = f"{name}{str(error).partition(chr(10))[0]}"
            if text not in self._problems:
                self._problems.append(text)
            return None

    def _strips(self) -> Iterator[tuple[TopicInfo, Strip]]:
        topics = [topic for topic in self._topics if topic.rows and has_pictures(topic)]
        for topic in topics[:MAX_STRIPS]:
            strip = self._attempt(topic, picture_strip)
            if strip is not None:
                yield topic, strip

    def _maps(self) -> Iterator[Map]:
        for topic in self._topics:
            if topic.rows and has_track(topic):
                track = self._attempt(topic, read_track)
                drawing = draw_map(track) if track is not None else None
                if drawing is not None:
                    yield drawing
                elif track is not None and len(track.positions):
                    self._fixed.append(_fixed_position(track))

    def _plots(self, described: Mapping[str, TopicStatistics | None]) -> Iterator[TopicPlots]:
        start_ns = self._info.start_ns or 0
        for topic in self._topics:
            statistics = described[topic.name]
            if not topic.rows or statistics is None or has_log(topic):
                continue
            plots = self._attempt(topic, lambda info: topic_plots(info, start_ns))
            if plots is not None:
                yield plots

    def _logs(self) -> Iterator[LogExcerpt]:
        for topic in self._topics:
            if topic.rows and has_log(topic):
                excerpt = self._attempt(topic, read_excerpt)
                if excerpt is not None:
                    yield excerpt


def _facts(info: SequenceInfo) -> dict[str, str]:
    start_ns, end_ns = info.start_ns, info.end_ns
    duration = seconds_text((end_ns - start_ns) / 1e9) if start_ns is not None and end_ns is not None else "-"
    return {
        "Topics": count_text(len(info.topics)),
        "Rows": count_text(info.rows),
        "Stored": bytes_text(info.stored_bytes),
        "Start (UTC)": time_text(start_ns),
        "Duration": duration,
    }


def _fixed_position(track: Positions) -> str:
    """Return the position of a topic that does not move."""
    position = track.positions[0].tolist()
    unit = "°, ".join(f"{value:.7g}" for value in position[:2]) + "°" if track.is_gps else ""
    return f"{track.topic} stays at {unit or ', '.join(f'{value:.4g} m' for value in position)}"


def _topic_view(topic: TopicInfo, statistics: TopicStatistics | None, axis: Axis | None) -> _TopicView:
    timing = statistics.timing if statistics else None
    timeline = timing.timeline if timing else None
    return _TopicView(
        topic,
        rate_text(timing.rate_hz) if timing else "",
        interval_text(timeline.jitter_ns) if timeline else "",
        timeline.gap_count if timeline else 0,
        draw_track(axis, topic.name, timeline, span=optional_span(topic.start_ns, topic.end_ns))
        if axis is not None
        else None,
        tuple(map(column_texts, statistics.columns)) if statistics else (),
    )


def _flatten(metadata: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield dotted keys and values as text, without the provenance and the attachments."""
    for key, value in metadata.items():
        if key in {PROVENANCE_KEY, ATTACHMENTS_KEY}:
            continue
        if isinstance(value, dict) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


class _Source(Struct, frozen=True):
    """A file that a session read."""

    session: str
    stored: str
    tool: str
    name: str
    size: str
    checksum: str


def _sources(info: SequenceInfo) -> Iterator[_Source]:
    for session in info.sessions:
        record: Any = session.metadata.get(PROVENANCE_KEY)
        sources: Any = record.get("sources") if isinstance(record, dict) else None
        for source in sources if isinstance(sources, list) else ():
            if isinstance(source, dict):
                size = source.get("size_bytes")
                yield _Source(
                    session.id,
                    time_text(session.completed_ns),
                    str(record.get("tool", "")),
                    str(source.get("name", "")),
                    bytes_text(size) if isinstance(size, int) else "",
                    str(source.get("content", "")),
                )


def _column(topic: TopicInfo) -> tuple[str, ...]:
    """Return the path of the first number of a topic, otherwise its first column after the time."""
    numbers = plotted_columns(topic)
    return tuple(numbers[0].steps) if numbers else tuple(topic.schema.names[1:2] or topic.schema.names)
