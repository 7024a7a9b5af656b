"""This file names the ways in which a run says what it does."""

from __future__ import annotations

from enum import Enum

__all__ = ["LogFormat"]


class LogFormat(str, Enum):
    """How lines are written."""

    TEXT = "text"
    JSON = "json"
