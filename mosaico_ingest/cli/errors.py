"""This file prints an error for a person: its findings with their source lines, else its one line."""

from __future__ import annotations

from collections.abc import Sequence

from rich.text import Text

from mosaico_ingest.cli.console import Terminal
from mosaico_ingest.cli.render import render_findings, texts_of
from mosaico_ingest.diagnostics import Finding

__all__ = ["print_error"]


def print_error(error: str, findings: Sequence[Finding]) -> None:
    """Print to standard error."""
    console = Terminal(stderr=True, soft_wrap=True)
    if findings:
        console.print(render_findings(findings, texts_of(findings)))
    else:
        console.print(Text.assemble(("error: ", "bold red"), error))
