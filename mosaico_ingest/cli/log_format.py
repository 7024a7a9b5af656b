"""This file names the ways in which a run says what it does."""

from __future__ import annotations

from enum import Enum
from typing import Annotated, TypeAlias

import typer

__all__ = ["LogFormat", "LogOption"]

LogOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--log",
        "-l",
        help="DEBUG, INFO, WARNING, ERROR or CRITICAL; overrides run.log_level.",
        metavar="LEVEL",
    ),
]
"""How much a command with a manifest says."""


class LogFormat(str, Enum):
    """How lines are written."""

    TEXT = "text"
    JSON = "json"
