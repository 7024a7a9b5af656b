"""This file writes a report where other programs read it."""

from __future__ import annotations

import os
from pathlib import Path

from mosaico_ingest.errors import SinkError
from mosaico_ingest.report.model import RunReport

__all__ = ["write_report"]


def write_report(report: RunReport, path: Path) -> None:
    """Write the report as JSON, whole or not at all.

    Raises:
        SinkError: The file cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise SinkError(f"cannot write the report: {error.strerror}", where=str(path)) from error
