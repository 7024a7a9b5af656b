"""The files of output options; `-` stands for standard output."""

from __future__ import annotations

import sys
from pathlib import Path

__all__ = ["STANDARD_OUTPUT", "write_output"]

STANDARD_OUTPUT = Path("-")
"""The path that output options accept for standard output."""


def write_output(path: Path, text: str, *, announce: bool = False) -> None:
    """Write the text of an output option: to a file, or to standard output if the path is `-`.

    With `announce`, print the name of the file to standard error.

    Raises:
        SinkError: The file cannot be written.
    """
    from mosaico_ingest.textfile import write_atomically

    if path == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return
    write_atomically(path, text)
    if announce:
        from mosaico_ingest.cli.console import print_line

        print_line(f"wrote {path}", stderr=True)
