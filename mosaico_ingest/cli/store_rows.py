"""`ingest store head`, `tail`, `sample`, `describe`, `sql`, `plot` and `image`: rows, statistics and pictures of topics."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.padding import Padding
from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal, print_json, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, JsonOption, StoreOption
from mosaico_ingest.display import (
    bytes_text,
    count_text,
    counted,
    interval_text,
    rate_text,
    seconds_text,
    time_text,
)

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

    from mosaico_ingest.destinations.store import SequenceInfo, Store, TopicInfo
    from mosaico_ingest.images import Pixels
    from mosaico_ingest.view.columns import TopicStatistics, TopicTiming
    from mosaico_ingest.view.series import Series

RECORD_WIDTH = 90
"""Characters of a value where each column of a row has its own line."""
MAX_GAPS = 5
"""Gaps of a topic that are listed."""
TopicArgument = Annotated[str, typer.Argument(metavar="SEQUENCE/TOPIC", help="A topic of a sequence.")]
CountOption = Annotated[int, typer.Option("--count", "-n", min=0, metavar="N", help="Number of rows.")]
ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        "-c",
        metavar="NAMES",
        help="Columns to print, separated by commas, such as acceleration.z,header.",
    ),
]
FlattenOption = Annotated[
    bool, typer.Option("--flatten", help="Print each member of a struct as a column of its own.")
]
CsvOption = Annotated[bool, typer.Option("--csv", help="Print CSV with flattened structs.")]
CELL_WIDTH = 60
"""Characters of a value in a table."""
DEFAULT_ROWS = 100
"""Rows that are printed as a table."""


STYLES = ("cyan", "yellow", "green", "magenta", "red", "blue", "bright_cyan", "bright_yellow")
"""Colors of the series of a chart."""

StartOption = Annotated[
    str | None, typer.Option("--from", metavar="TIME", help="Start here: a time, or an offset such as +10s.")
]
EndOption = Annotated[
    str | None, typer.Option("--until", metavar="TIME", help="End here: a time, or an offset such as +20s.")
]


def head(
    path: TopicArgument,
    *,
    store: StoreOption = DEFAULT_STORE,
    count: CountOption = 10,
    columns: ColumnsOption = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="TIME", help="Start here: a time, or an offset such as +10s or -5s."),
    ] = None,
    flatten: FlattenOption = False,
    as_json: JsonOption = False,
    as_csv: CsvOption = False,
) -> None:
    """Print the first rows of a topic, or the first rows from a time on."""
    from mosaico_ingest.view.rows import first_rows

    rows = _RowView(store, path, columns, flatten=flatten, as_json=as_json, as_csv=as_csv)
    start_ns = None if at is None else time_option(rows.topic, at)
    rows.print(first_rows(rows.topic, count, columns=rows.top_level, start_ns=start_ns))


def tail(
    path: TopicArgument,
    *,
    store: StoreOption = DEFAULT_STORE,
    count: CountOption = 10,
    columns: ColumnsOption = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="TIME", help="End here: a time, or an offset such as +10s or -5s."),
    ] = None,
    flatten: FlattenOption = False,
    as_json: JsonOption = False,
    as_csv: CsvOption = False,
) -> None:
    """Print the last rows of a topic, or the last rows until a time."""
    from mosaico_ingest.view.rows import last_rows

    rows = _RowView(store, path, columns, flatten=flatten, as_json=as_json, as_csv=as_csv)
    end_ns = None if at is None else time_option(rows.topic, at)
    rows.print(last_rows(rows.topic, count, columns=rows.top_level, end_ns=end_ns))


def sample(
    path: TopicArgument,
    *,
    store: StoreOption = DEFAULT_STORE,
    count: CountOption = 10,
    columns: ColumnsOption = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at", metavar="TIME", help="Print the row nearest to this time or offset. Repeatable."
        ),
    ] = None,
    flatten: FlattenOption = False,
    as_json: JsonOption = False,
    as_csv: CsvOption = False,
) -> None:
    """Print rows at equal distances, or the rows nearest to some times."""
    from mosaico_ingest.view.rows import rows_near, sampled_rows

    rows = _RowView(store, path, columns, flatten=flatten, as_json=as_json, as_csv=as_csv)
    if at:
        times_ns = [time_option(rows.topic, text) for text in at]
        rows.print(rows_near(rows.topic, times_ns, columns=rows.top_level))
    else:
        rows.print(sampled_rows(rows.topic, count, columns=rows.top_level))


def describe(
    path: Annotated[
        str, typer.Argument(metavar="SEQUENCE[/TOPIC]", help="A sequence, or one of its topics.")
    ],
    store: StoreOption = DEFAULT_STORE,
    every: Annotated[
        bool, typer.Option("--all", help="Also print columns that are null in every row.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print rate, jitter and gaps of each topic of a sequence and its attachments, or the statistics of a topic's columns."""
    from msgspec import to_builtins

    from mosaico_ingest.cli.store import attachment_json, print_attachments
    from mosaico_ingest.view.columns import describe_topic, topic_timing
    from mosaico_ingest.view.texts import json_value

    opened = _opened(store)
    sequence, _, topic = path.lstrip("/").partition("/")
    if topic:
        described = describe_topic(opened.topic(sequence, topic))
        if as_json:
            print_json(json_value(to_builtins(described, enc_hook=_builtin)))
        else:
            _print_topic_statistics(described, every=every)
        return
    info = opened.sequence(sequence)
    timings = [(topic, topic_timing(topic)) for topic in info.topics]
    if as_json:
        topics = [
            {"topic": topic.name, "ontology": topic.ontology.tag, **to_builtins(timing, enc_hook=_builtin)}
            for topic, timing in timings
        ]
        attachments = [attachment_json(each) for each in info.attachments]
        print_json({"sequence": info.name, "topics": topics, "attachments": attachments})
    else:
        _print_timings(info, timings)
        print_attachments(info.attachments)


def sql(
    query: Annotated[
        str | None,
        typer.Argument(metavar="QUERY", help="One SELECT statement; without it, the tables are listed."),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="Write the result to a .parquet, .csv or .json file."
        ),
    ] = None,
    limit: Annotated[
        int, typer.Option("--limit", "-n", min=1, metavar="N", help="Number of rows to print as a table.")
    ] = DEFAULT_ROWS,
    as_csv: CsvOption = False,
    as_json: JsonOption = False,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Query topics with SQL (DuckDB): `SELECT avg(acceleration.z) FROM quickstart_drive.imu`. Read-only.

    A topic such as /gps/fix is the table SEQUENCE."gps/fix" or SEQUENCE.gps_fix.
    """
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.view.pictures import require_suffix
    from mosaico_ingest.view.sql import run_query

    if out is not None:
        require_suffix(out, (".parquet", ".csv", ".json"))
    opened = Store.open(store, create=False)
    if query is None:
        _print_tables(opened, as_json=as_json)
        return
    reader = run_query(opened, query)
    if out is not None:
        rows = _write(reader, out, out.suffix.lower())
        print_line(f"wrote {out}: {counted(rows, 'row')}", stderr=True)
    elif as_csv:
        _write_csv(reader, sys.stdout)
    elif as_json:
        _print_query_json(reader)
    else:
        _print_table(reader, limit)


def plot(
    path: TopicArgument,
    fields: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FIELD",
            help="Columns or structs, such as acceleration.z or acceleration; some measurements if omitted.",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write a .png, .svg, .pdf, .jpg or .webp file."),
    ] = None,
    start: StartOption = None,
    end: EndOption = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Plot fields of a topic over time, in the terminal or to a file. Every extreme value is kept."""
    from mosaico_ingest.errors import ViewError
    from mosaico_ingest.view.series import plot_fields, read_series, write_chart

    topic = open_topic(store, path)
    names = fields or plot_fields(topic)
    title = f"{topic.sequence}{topic.name}"
    if not names:
        raise ViewError(f"rows of {topic.ontology.tag} contain no numbers to plot", where=title)
    start_ns = None if start is None else time_option(topic, start, option="--from")
    end_ns = None if end is None else time_option(topic, end, option="--until")
    series = read_series(topic, names, start_ns=start_ns, end_ns=end_ns)
    if not any(len(each.values) for each in series):
        print_line(f"{title}: no rows here")
    elif out is not None:
        write_chart(series, out, title=title)
        print_line(f"wrote {out}", stderr=True)
    else:
        _print_chart(series, title)


def image(
    path: TopicArgument,
    *,
    at: Annotated[
        str | None,
        typer.Option(
            "--at", metavar="TIME", help="Show the row nearest to this time, or to an offset such as +10s."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="File to write, as .png, .jpg or .webp.",
            show_default="TOPIC.png",
        ),
    ] = None,
    sheet: Annotated[
        bool, typer.Option("--contact-sheet", help="Show small pictures at equal distances in time.")
    ] = False,
    count: Annotated[
        int, typer.Option("--count", "-n", min=1, metavar="N", help="Number of pictures of a contact sheet.")
    ] = 12,
    size: Annotated[
        int,
        typer.Option("--size", min=16, metavar="PIXELS", help="Largest side of a point cloud from above."),
    ] = 800,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Write the picture of a row: images in their colors, depth color-mapped, point clouds from above."""
    from mosaico_ingest.view.pictures import row_picture, write_picture
    from mosaico_ingest.view.rows import nearest_row

    topic = open_topic(store, path)
    target = out or Path(f"{topic.name.strip('/').replace('/', '-')}.png")
    if sheet:
        pixels, facts = _contact_sheet(topic, count, size)
    else:
        row = nearest_row(topic, None if at is None else time_option(topic, at))
        if row is None:
            print_line(f"{topic.sequence}{topic.name}: no rows here")
            return
        pixels, facts = row_picture(topic, row, size=size), _row_facts(topic, row)
    write_picture(pixels, target)
    height, width, _ = pixels.shape
    print_line(f"wrote {target}: {width} x {height} pixels, {facts}")


def open_topic(store: str, path: str) -> TopicInfo:
    """Return the topic of an argument `SEQUENCE/TOPIC`; raises a usage error if it names no topic."""
    sequence, _, topic = path.lstrip("/").partition("/")
    opened = _opened(store)
    if not topic:
        names = ", ".join(f"{sequence}{info.name}" for info in opened.sequence(sequence).topics)
        raise typer.BadParameter(f"{path} names no topic; choose one of {names}", param_hint="SEQUENCE/TOPIC")
    return opened.topic(sequence, topic)


def time_option(info: TopicInfo | SequenceInfo, text: str, *, option: str = "--at") -> int:
    """Return the ns of an option: nanoseconds, an instant, or an offset from the start (`+`) or the end (`-`)."""
    from mosaico_ingest.job.values import parse_time

    if text.isdecimal() and len(text) < 20:  # noqa: PLR2004 - the digits of 64 bits
        return int(text)
    try:
        bound = parse_time(text)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from error
    if not bound.relative:
        return bound.ns
    origin = info.start_ns if bound.ns >= 0 and not text.startswith("-") else info.end_ns
    return (origin or 0) + bound.ns


def _opened(store: str) -> Store:
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.destinations.store import Store

    collect_garbage_as_usual()
    hide_pandas()
    return Store.open(store, create=False)


def _selected(topic: TopicInfo, columns: str) -> list[str]:
    from mosaico_ingest.findings import suggest_names
    from mosaico_ingest.view.columns import struct_paths

    names = [name.strip() for name in columns.split(",") if name.strip()]
    paths = struct_paths(topic.schema)
    for name in names:
        if name not in paths:
            hint = suggest_names(paths, [name])
            raise typer.BadParameter(f"there is no column {name!r}; {hint}", param_hint="--columns")
    return names


class _RowView:
    """A topic, its selected columns, and the form in which its rows are printed."""

    def __init__(
        self, store: str, path: str, columns: str | None, *, flatten: bool, as_json: bool, as_csv: bool
    ) -> None:
        """Open the topic.

        Raises:
            BadParameter: The path names no topic, or a column does not exist.
        """
        self.topic = open_topic(store, path)
        self._paths = None if columns is None else _selected(self.topic, columns)
        self._flatten, self._as_json, self._as_csv = flatten, as_json, as_csv

    @property
    def top_level(self) -> list[str] | None:
        """The top-level columns that contain the selected ones; None for all columns."""
        return self._paths and list(dict.fromkeys(path.partition(".")[0] for path in self._paths))

    def print(self, table: pa.Table) -> None:
        """Print rows of the topic as JSON, as CSV, or for people."""
        from mosaico_ingest.view.columns import flat_columns, path_values, time_values

        names = [table.schema.names[0], *(self._paths or table.schema.names[1:])]
        cells = {name: path_values(table, name) for name in dict.fromkeys(names)}
        if self._flatten or self._as_csv:
            cells = {
                path: values for name, array in cells.items() for path, values in flat_columns(name, array)
            }
        if self._as_json:
            _print_rows_json(cells, table.num_rows)
        elif self._as_csv:
            _print_csv({path: time_values(values) for path, values in cells.items()})
        elif table.num_rows:
            _print_columns(cells)
        else:
            print_line(f"{self.topic.sequence}{self.topic.name}: no rows here")


def _print_rows_json(cells: Mapping[str, pa.Array[Any]], rows: int) -> None:
    from mosaico_ingest.view.texts import json_value

    lists = {name: values.to_pylist() for name, values in cells.items()}
    print_json([json_value({name: lists[name][row] for name in lists}) for row in range(rows)])


def _print_csv(cells: Mapping[str, pa.Array[Any]]) -> None:
    from mosaico_ingest.view.texts import flat_text

    writer = csv.writer(sys.stdout)
    writer.writerow(cells)
    columns = ([flat_text(value) for value in values.to_pylist()] for values in cells.values())
    writer.writerows(zip(*columns, strict=True))


def _print_columns(cells: Mapping[str, pa.Array[Any]]) -> None:
    """Print the columns with values; the first column is the time."""
    empty = [name for name, values in cells.items() if values.null_count == len(values)]
    texts = {
        name: _cell_texts(values, is_time=at == 0)
        for at, (name, values) in enumerate(cells.items())
        if name not in empty
    }
    _print_texts(texts)
    if empty:
        noun = "column is" if len(empty) == 1 else "columns are"
        print_line(f"{count_text(len(empty))} more {noun} null in these rows", style="dim")


def _cell_texts(values: pa.Array[Any], *, is_time: bool) -> list[str]:
    from mosaico_ingest.view.texts import instant_text, scalar_text

    if is_time:
        return [instant_text(value) for value in values.to_pylist() if value is not None]
    return [scalar_text(value, RECORD_WIDTH) for value in values]


def _print_texts(texts: dict[str, list[str]]) -> None:
    """Print a line for each row if that fits the terminal, otherwise a line for each column of each row."""
    console = Terminal()
    widths = [max(len(name), *map(len, column)) for name, column in texts.items()]
    if sum(widths) + 2 * len(widths) <= console.width:
        table = PlainTable(*texts, numbers=texts.keys())
        for column in table.columns:
            column.justify = "left"
        for cells in zip(*texts.values(), strict=True):
            table.add_row(*cells)
        console.print(table)
        return
    (time_name, times), *others = texts.items()
    for row, time in enumerate(times):
        print_line(f"{time_name} {time}", style="bold")
        table = PlainTable("column", "value", header=False)
        for name, column in others:
            table.add_row(Text(name, style="cyan"), column[row])
        console.print(Padding.indent(table, 2))


def _print_timings(info: SequenceInfo, timings: Sequence[tuple[TopicInfo, TopicTiming]]) -> None:
    print_line(info.name, style="bold")
    names = ("topic", "ontology", "rows", "size", "rate", "jitter", "gaps", "longest gap")
    table = PlainTable(*names, numbers=set(names[2:]))
    for topic, timing in timings:
        gaps = timing.timeline.gaps if timing.timeline else ()
        longest = max((gap.end_ns - gap.start_ns for gap in gaps), default=None)
        table.add_row(
            topic.name,
            topic.ontology.tag,
            count_text(timing.rows),
            bytes_text(topic.stored_bytes),
            rate_text(timing.rate_hz),
            _jitter(timing),
            count_text(timing.timeline.gap_count if timing.timeline else 0),
            "" if longest is None else seconds_text(longest / 1e9),
        )
    Terminal().print(table)


def _print_topic_statistics(described: TopicStatistics, *, every: bool) -> None:
    from msgspec.structs import astuple

    from mosaico_ingest.view.texts import column_texts

    timing = described.timing
    print_line(f"{described.sequence}{described.topic}", style="bold")
    span = f"{time_text(timing.start_ns)} .. {time_text(timing.end_ns)} UTC"
    facts = [described.ontology, counted(timing.rows, "row"), span]
    if timing.rate_hz is not None:
        facts += [rate_text(timing.rate_hz), f"jitter {_jitter(timing)}"]
    print_line(", ".join(facts))
    if timing.timeline is not None and timing.timeline.gap_count:
        _print_gaps(timing)
    columns = [column for column in described.columns if every or column.rows != 0]
    names = ("column", "type", "unit", "nulls", "min", "max", "mean", "distinct")
    table = PlainTable(*names, numbers={"nulls", "min", "max", "mean", "distinct"})
    for column in columns:
        texts = column_texts(column)
        table.add_row(Text(texts.path, style="cyan"), *astuple(texts)[1:])
    Terminal().print(table)
    hidden = len(described.columns) - len(columns)
    if hidden:
        noun = "column is" if hidden == 1 else "columns are"
        print_line(f"{count_text(hidden)} more {noun} null in every row; --all prints them", style="dim")


def _print_gaps(timing: TopicTiming) -> None:
    if timing.timeline is None:
        return
    gaps = sorted(timing.timeline.gaps, key=lambda gap: gap.start_ns - gap.end_ns)[:MAX_GAPS]
    limit = "" if timing.timeline.gap_count <= MAX_GAPS else f", the {MAX_GAPS} longest"
    print_line(f"{counted(timing.timeline.gap_count, 'gap')}{limit}:", style="yellow")
    for gap in sorted(gaps, key=lambda gap: gap.start_ns):
        length = seconds_text((gap.end_ns - gap.start_ns) / 1e9)
        print_line(f"  {length} from {time_text(gap.start_ns)} to {time_text(gap.end_ns)}", style="yellow")


def _jitter(timing: TopicTiming) -> str:
    return interval_text(timing.timeline.jitter_ns) if timing.timeline else ""


def _builtin(value: Any) -> Any:  # noqa: ANN401 - msgspec's hook
    return value.model_dump() if hasattr(value, "model_dump") else str(value)


def _print_tables(store: Store, *, as_json: bool) -> None:
    from mosaico_ingest.view.sql import table_names

    tables = [
        (f"{_identifier(info.name)}.{_identifier(table_names(info, topic)[-1])}", topic)
        for info in store.sequences()
        for topic in info.topics
    ]
    if as_json:
        print_json(
            [{"table": name, "ontology": topic.ontology.tag, "rows": topic.rows} for name, topic in tables]
        )
        return
    table = PlainTable("table", "ontology", "rows", numbers={"rows"})
    for name, topic in tables:
        table.add_row(name, topic.ontology.tag, count_text(topic.rows))
    Terminal().print(table)


def _identifier(name: str) -> str:
    return name if name.isidentifier() and name.isascii() else '"' + name.replace('"', '""') + '"'


def _print_table(reader: pa.RecordBatchReader, limit: int) -> None:
    from mosaico_ingest.view.texts import scalar_text

    names = reader.schema.names
    rows, has_more = list[tuple[str, ...]](), False
    for batch in reader:
        has_more = has_more or len(rows) + batch.num_rows > limit
        part = batch.slice(0, limit - len(rows))
        rows += zip(
            *([scalar_text(value, CELL_WIDTH) for value in column] for column in part.columns), strict=True
        )
        if has_more:
            break
    table = PlainTable(*names, numbers={field.name for field in reader.schema if _is_number(field.type)})
    for row in rows:
        table.add_row(*row)
    Terminal().print(table)
    if has_more:
        more = "--limit prints more, --out writes all"
        print_line(f"the first {counted(limit, 'row')}; {more}", style="dim", stderr=True)


def _is_number(kind: pa.DataType) -> bool:
    from mosaico_ingest.view.columns import is_number

    return is_number(kind)


def _print_query_json(reader: pa.RecordBatchReader) -> None:
    from mosaico_ingest.view.texts import json_value

    print_json([json_value(row) for batch in reader for row in batch.to_pylist()])


def _write(reader: pa.RecordBatchReader, path: Path, suffix: str) -> int:
    """Write the result batch by batch, and return its number of rows."""
    import json

    import pyarrow.parquet as pq

    from mosaico_ingest.view.texts import json_value

    rows = 0
    if suffix == ".parquet":
        with pq.ParquetWriter(path, reader.schema, compression="zstd") as writer:
            for batch in reader:
                writer.write_batch(batch)
                rows += batch.num_rows
        return rows
    with path.open("w", encoding="utf-8", newline="") as file:
        if suffix == ".csv":
            return _write_csv(reader, file)
        for batch in reader:
            for row in batch.to_pylist():
                start = ",\n " if rows else "[\n "
                file.write(f"{start}{json.dumps(json_value(row), ensure_ascii=False)}")
                rows += 1
        file.write("\n]\n" if rows else "[]\n")
    return rows


def _write_csv(reader: pa.RecordBatchReader, file: Any) -> int:  # noqa: ANN401 - a text file
    from mosaico_ingest.view.texts import flat_text

    writer = csv.writer(file)
    writer.writerow(reader.schema.names)
    rows = 0
    for batch in reader:
        columns = ([flat_text(value) for value in column.to_pylist()] for column in batch.columns)
        writer.writerows(zip(*columns, strict=True))
        rows += batch.num_rows
    return rows


CHART_HEIGHT = 16
"""Lines of a chart."""
CHART_WIDTH = 120
"""Maximum number of columns of a chart."""


def _contact_sheet(topic: TopicInfo, count: int, size: int) -> tuple[Pixels, str]:
    """Return the contact sheet, and its description."""
    from mosaico_ingest.errors import ViewError
    from mosaico_ingest.view.pictures import contact_sheet, thumbnails

    side = min(size, 400)
    pictures = thumbnails(topic, count, width=side, height=side)
    labeled = [
        (f"+{seconds_text(each.offset_s)}", each.pixels) for each in pictures if each.pixels is not None
    ]
    problems = [each.problem for each in pictures if each.problem is not None]
    if not labeled:
        raise ViewError(
            problems[0] if problems else "there are no rows", where=f"{topic.sequence}{topic.name}"
        )
    for problem in dict.fromkeys(problems):
        print_line(f"{problems.count(problem)} of {len(pictures)}: {problem}", style="yellow", stderr=True)
    return contact_sheet(labeled), f"{len(labeled)} pictures"


def _row_facts(topic: TopicInfo, row: dict[str, object]) -> str:
    from mosaico_ingest.view.texts import instant_text

    time_ns = row[topic.schema.names[0]]
    kind = row.get("encoding") or topic.metadata.get("ros_format") or row.get("format") or topic.ontology.tag
    return f"{kind}, {instant_text(time_ns) if isinstance(time_ns, int) else '-'}"


def _print_chart(series: list[Series], title: str) -> None:
    """Print a chart for each unit, with a legend of smallest and largest values."""
    from mosaico_ingest.view.series import chart_lines

    console = Terminal()
    width = min(console.width, CHART_WIDTH)
    for unit in dict.fromkeys(each.unit for each in series):
        group = [each for each in series if each.unit == unit]
        print_line(f"{title}{f' in {unit}' if unit else ''}", style="bold")
        for number, each in enumerate(group):
            style = STYLES[number % len(STYLES)]
            console.print(Text.assemble(("━ ", style), each.label, (f"  {_bounds(each.values)}", "dim")))
        for line in chart_lines(group, width=width, height=CHART_HEIGHT):
            text = Text(line.label, style="dim")
            for character, owner in zip(line.text, line.owners, strict=True):
                text.append(character, style=STYLES[owner % len(STYLES)] if owner >= 0 else "")
            console.print(text)


def _bounds(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    import numpy as np

    finite = values[np.isfinite(values)]
    return f"{finite.min():.6g} .. {finite.max():.6g}" if len(finite) else "no finite values"
