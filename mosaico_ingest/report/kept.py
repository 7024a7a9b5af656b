"""This file leads from a report to the messages that were set aside: where they lie, and how they come in after all."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from urllib.parse import quote

from mosaico_ingest.report.model import Report, RunReport

__all__ = ["folder_link", "replay_command"]


def replay_command(report: RunReport, one: Report) -> str | None:
    """Return what to type once the manifest is mended; None where nothing was set aside."""
    if one.quarantine is None:
        return None
    manifests = [used.path for used in report.manifests]
    job = shlex.quote(manifests[0]) if len(manifests) == 1 else "JOB.yaml"
    return f"ingest replay {shlex.quote(str(Path(one.quarantine).parent))} --manifest {job}"


def folder_link(one: Report, page_folder: Path) -> str | None:
    """Return the link from a page in `page_folder` to the folder with the messages set aside."""
    if one.quarantine is None:
        return None
    folder = os.path.relpath(Path(one.quarantine).absolute().parent, page_folder.absolute())
    return quote(Path(folder).as_posix().encode("utf-8", "surrogateescape")) + "/"
