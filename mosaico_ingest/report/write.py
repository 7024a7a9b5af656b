"""This file writes a report where other programs read it, and reads it back."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.report.model import RunReport
from mosaico_ingest.textfile import write_whole

__all__ = ["read_report", "write_report"]


def write_report(report: RunReport, path: Path) -> None:
    """Write the report as JSON, whole or not at all.

    Raises:
        SinkError: The file cannot be written.
    """
    write_whole(path, report.model_dump_json(indent=2) + "\n")


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
