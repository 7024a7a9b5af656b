"""Programs in a pseudo terminal, and pictures of their output."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Collection
from pathlib import Path

from rich.console import Console
from rich.text import Text

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Zac-ln-z]")
"""Escape sequences that move the cursor or erase text; sequences that end with `m` only set colors."""
FONT_FACE = re.compile(r"@font-face \{.*?\}\s*", re.DOTALL)


def in_terminal(words: list[str], width: int, folder: Path) -> list[str]:
    """Return the lines that a command of `ingest` prints to a terminal of this width."""
    return printed_lines(["-m", "mosaico_ingest", *words], width, folder)


def printed_lines(arguments: list[str], width: int, folder: Path) -> list[str]:
    """Return the lines that Python prints to a terminal of this width, including overwritten lines."""
    text = ESCAPE.sub("", captured(arguments, width, folder))
    return [line.rstrip() for line in text.splitlines()]


def captured(arguments: list[str], width: int, folder: Path, *, codes: Collection[int] = (0, 1)) -> str:
    """Return the characters that Python sends to a terminal of this width, with escape sequences."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, width, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}}
    with subprocess.Popen(  # noqa: S603 - our own code
        [sys.executable, *arguments],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=folder,
        env={**environment, "TERM": "xterm"},
    ) as process:
        os.close(theirs)
        output = b""
        while True:
            try:
                part = os.read(ours, 1 << 16)
            except OSError:  # Linux reports the end of a terminal as an error
                break
            if not part:
                break
            output += part
    os.close(ours)
    assert process.returncode in codes, output.decode()
    return output.decode().replace("\r\n", "\n")


def terminal_picture(output: str, *, command: str, width: int) -> str:
    """Return an SVG picture of a terminal with a command and its output, without fonts of other servers."""
    console = Console(
        record=True, width=width, file=io.StringIO(), force_terminal=True, color_system="truecolor"
    )
    console.print(Text.assemble(("$ ", "bold green"), (command, "bold")), soft_wrap=True)
    console.print(Text.from_ansi(visible(output).rstrip("\n")), no_wrap=False, overflow="fold")
    picture = FONT_FACE.sub("", console.export_svg(title="", unique_id="terminal"))
    return (
        "\n".join(line.rstrip() for line in picture.replace("Fira Code", "ui-monospace").splitlines()) + "\n"
    )


def visible(output: str) -> str:
    """Return output without the progress that it erases, and without sequences that move the cursor."""
    return CONTROL.sub("", output.rpartition("\x1b[2K")[2])


def picture_text(picture: str) -> str:
    """Return the characters of a picture of a terminal without white space, and with `#` in place of numbers."""
    lines = re.findall(r"<text[^>]*clip-path[^>]*>(.*?)</text>", picture, re.DOTALL)
    text = (
        "".join(lines)
        .replace("&#160;", "")
        .replace("&quot;", '"')
        .replace("&amp;", "&")
        .replace("&#x27;", "'")
    )
    return re.sub(r"[\d.,]+", "#", re.sub(r"\s", "", text))
