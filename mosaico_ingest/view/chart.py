"""Charts of series: as text for a terminal, and as a picture file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from mosaico_ingest.errors import missing_library
from mosaico_ingest.report.units import seconds_text, time_text
from mosaico_ingest.view.images import require_suffix
from mosaico_ingest.view.series import Series

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)
"""The bit of each of the 4 x 2 dots of a Braille character."""
_BRAILLE = 0x2800
_LABEL = 11
"""Characters of the values beside the axis."""
_SUFFIXES = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".webp")


class ChartLine(Struct, frozen=True):
    """A line of a chart in text: the label of the axis, then cells with the number of the series that is drawn there."""

    label: str
    text: str
    owners: tuple[int, ...]
    """The position of the series for each character of `text`; -1 without one."""


def chart_lines(series: Sequence[Series], *, width: int, height: int) -> list[ChartLine]:
    """Return a chart of Braille dots with `height` lines of at most `width` characters; empty without finite values."""
    columns = max(10, width - _LABEL - 2)
    finite = [np.isfinite(each.values) for each in series]
    if not any(mask.any() for mask in finite):
        return []
    values = [each.values[mask] for each, mask in zip(series, finite, strict=True)]
    times = [each.times_ns[mask] for each, mask in zip(series, finite, strict=True)]
    low, high = _range(values)
    start_ns, end_ns = (
        min(int(each[0]) for each in times if len(each)),
        max(int(each[-1]) for each in times if len(each)),
    )
    cells = np.zeros((height, columns), np.uint8)
    owners = np.full((height, columns), -1)
    for number, (moments, numbers) in enumerate(zip(times, values, strict=True)):
        x = (moments - start_ns) / max(1, end_ns - start_ns) * (columns * 2 - 1)
        y = (high - numbers) / (high - low) * (height * 4 - 1)
        for row, column in _dots(x, y):
            cells[row // 4, column // 2] |= _DOTS[row % 4, column % 2]
            owners[row // 4, column // 2] = number
    labels = {
        0: high,
        height - 1: low,
        (height - 1) // 2: high + (low - high) * ((height - 1) // 2) / (height - 1),
    }
    lines = [
        ChartLine(
            f"{f'{labels[row]:.4g}' if row in labels else '':>{_LABEL}} ┤",
            "".join(chr(_BRAILLE + int(cell)) if cell else " " for cell in cells[row]),
            tuple(int(owner) for owner in owners[row]),
        )
        for row in range(height)
    ]
    first, last = time_text(start_ns), f"+{seconds_text((end_ns - start_ns) / 1e9)}"
    if len(first) + len(last) >= columns:
        first = first.partition(" ")[2]  # the time without the date
    axis = f"{first}{last:>{max(1, columns - len(first))}}"
    return [*lines, ChartLine(" " * (_LABEL + 2), axis, (-1,) * len(axis))]


def write_chart(series: Sequence[Series], path: Path, *, title: str) -> None:
    """Write a chart with a panel for each unit, as PNG, SVG, PDF, JPEG or WebP by the suffix of the file.

    Raises:
        ViewError: The suffix is unknown.
        IngestError: Matplotlib is not installed.
    """
    require_suffix(path, _SUFFIXES)
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an optional library
    except ImportError as error:
        raise missing_library("Matplotlib", "plot") from error
    units = list(dict.fromkeys(each.unit for each in series))
    figure: Any = Figure(figsize=(10, 1.2 + 2.6 * len(units)), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    start_ns = min((int(each.times_ns[0]) for each in series if len(each.times_ns)), default=0)
    for unit, panel in zip(units, panels, strict=True):
        for each in series:
            if each.unit == unit:
                seconds = (each.times_ns - start_ns) / 1e9
                marker = "." if len(seconds) < 50 else ""  # noqa: PLR2004 - few points are hard to see as a line
                panel.plot(seconds, each.values, linewidth=1, marker=marker, label=each.label)
        panel.set_ylabel(unit)
        panel.grid(visible=True, alpha=0.3)
        panel.legend(loc="upper right", fontsize="small")
    panels[-1].set_xlabel(f"s after {time_text(start_ns)} UTC")
    figure.savefig(path, dpi=120)


def _range(values: Sequence[npt.NDArray[np.float64]]) -> tuple[float, float]:
    numbers = np.concatenate(values)
    low, high = float(numbers.min()), float(numbers.max())
    if high > low:
        return low, high
    margin = abs(low) / 10 or 1.0
    return low - margin, high + margin


def _dots(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the row and column of each dot on the lines between consecutive points."""
    if len(x) == 1:
        return [(round(y[0]), round(x[0]))]
    steps = np.ceil(np.maximum(np.abs(np.diff(x)), np.abs(np.diff(y)))).astype(np.int64) + 1
    starts = np.repeat(np.arange(len(steps)), steps)
    share = (np.arange(len(starts)) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(
        np.maximum(steps - 1, 1), steps
    )
    columns = np.rint(x[starts] + share * (x[starts + 1] - x[starts])).astype(int)
    rows = np.rint(y[starts] + share * (y[starts + 1] - y[starts])).astype(int)
    return list(dict.fromkeys(zip(rows.tolist(), columns.tolist(), strict=True)))
