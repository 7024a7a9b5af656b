"""`ingest store plot` and `image`: charts of fields, and pictures of images, point clouds and grids."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, StoreOption
from mosaico_ingest.cli.store_rows import TopicArgument, open_topic, time_option
from mosaico_ingest.display import seconds_text

if TYPE_CHECKING:
    import numpy as np

    from mosaico_ingest.destinations.store import TopicInfo
    from mosaico_ingest.images import Pixels
    from mosaico_ingest.view.series import Series

CHART_HEIGHT = 16
"""Lines of a chart."""
CHART_WIDTH = 120
"""Maximum number of columns of a chart."""
STYLES = ("cyan", "yellow", "green", "magenta", "red", "blue", "bright_cyan", "bright_yellow")
"""Colors of the series of a chart."""

StartOption = Annotated[
    str | None, typer.Option("--from", metavar="TIME", help="Start here: a time, or an offset such as +10s.")
]
EndOption = Annotated[
    str | None, typer.Option("--until", metavar="TIME", help="End here: a time, or an offset such as +20s.")
]


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
