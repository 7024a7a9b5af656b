"""The check of `path-outside`: a relative path that leaves the repository."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath
from pathlib import Path

from mosaico_ingest.lint.check import Check, Job, Problem, manifest_paths


def check(job: Job) -> Iterator[Problem]:
    """Report each relative path outside of the folder that contains `.git`."""
    root = next((folder for folder in _ancestors(job.folder) if (folder / ".git").exists()), None)
    if root is None:
        return
    for path, text in manifest_paths(job):
        resolved = Path(normpath(job.folder.resolve() / text))
        if text.startswith("..") and root not in _ancestors(resolved):
            message = f"{text} is outside of the repository {root}"
            yield Problem(message, job.source.span(path), "use a variable: ${DATA}/…")


def _ancestors(folder: Path) -> list[Path]:
    return [folder.resolve(), *folder.resolve().parents]


CHECK = Check("path-outside", job=check, reads_files=True)
