"""This file is the terminal as the commands see it: what recordings and manifests say cannot control it."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

__all__ = ["Terminal", "plain_table", "print_line"]

_CONTROLLING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_WIDE = 240
"""Columns of output that goes to a file or a pipe, where nothing needs to be folded."""


class Terminal(Console):
    """Prints text as it is: no markup, no emoji names, and a visible sign in place of each control character."""

    def __init__(self, *, stderr: bool = False, soft_wrap: bool = False) -> None:
        stream = sys.stderr if stderr else sys.stdout
        width = None if stream is not None and stream.isatty() else _WIDE  # None where it was closed
        super().__init__(
            stderr=stderr, soft_wrap=soft_wrap, width=width, markup=False, emoji=False, highlight=False
        )

    def on_broken_pipe(self) -> None:
        """Go on in silence where the reader has gone, as in `ingest job.yaml | head`: what is done, and its exit code, count."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if self.stderr else sys.stdout).fileno())

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render as every console does, then take the controls out of the text."""
        for segment in super().render(renderable, options):
            yield (
                segment if segment.control else Segment(_CONTROLLING.sub(_sign, segment.text), segment.style)
            )


def plain_table(*names: str, numbers: Collection[str] = ()) -> Table:
    """Return a table without lines whose columns fold what is long, except those of `numbers`."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in names:
        number = name in numbers
        table.add_column(name, justify="right" if number else "left", overflow="fold", no_wrap=number)
    return table


def print_line(line: str, *, stderr: bool = False) -> None:
    """Print a line that may hold what a recording, a manifest or a file name says."""
    Terminal(stderr=stderr, soft_wrap=True).print(Text(line))


def _sign(match: re.Match[str]) -> str:
    code = ord(match[0])
    return chr(0x2400 + code) if code < 0x20 else "\ufffd"  # noqa: PLR2004 - Unicode has a picture of each C0 control
