"""This file writes a report where other programs read it, and reads it back."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import ValidationError

from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.report.model import RunReport

__all__ = ["check_file", "read_report", "write_report", "write_whole"]


def check_file(path: Path) -> None:
    """Refuse what cannot be a file to write, before there is anything to write.

    Raises:
        ManifestError: It is a folder.
    """
    if path.is_dir():
        raise ManifestError("is a folder", where=str(path), hint="name a file")


def write_report(report: RunReport, path: Path) -> None:
    """Write the report as JSON, whole or not at all.

    Raises:
        SinkError: The file cannot be written.
    """
    write_whole(path, report.model_dump_json(indent=2) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Raises:
        ManifestError: It is a folder.
        SinkError: The file cannot be written.
    """
    check_file(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise SinkError(f"cannot be written: {error.strerror}", where=str(path)) from error


def read_report(path: Path) -> RunReport:
    """Read a report file.

    Raises:
        ManifestError: It is not there, or no report.
    """
    try:
        return RunReport.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise ManifestError(
            f"is no report: {place}: {first['msg']}",
            where=str(path),
            hint="`ingest run --report FILE` writes one",
        ) from error
