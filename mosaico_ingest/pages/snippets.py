"""Programs that read a sequence, ready to copy."""

from __future__ import annotations

import shlex

from msgspec import Struct

from mosaico_ingest.destinations.store import SequenceInfo, Store, TopicInfo
from mosaico_ingest.pages.plots import plotted_columns


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


def _column(topic: TopicInfo) -> tuple[str, ...]:
    """Return the path of the first number of a topic, otherwise its first column after the time."""
    numbers = plotted_columns(topic)
    return tuple(numbers[0].steps) if numbers else tuple(topic.schema.names[1:2] or topic.schema.names)
