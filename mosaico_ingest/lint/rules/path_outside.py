"""The rule `path-outside`: a relative path that leaves the repository."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath
from pathlib import Path

from mosaico_ingest.lint.job import Job, all_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each relative path outside the folder that holds `.git`."""
    root = next((folder for folder in _ancestors(job.folder) if (folder / ".git").exists()), None)
    if root is None:
        return
    for place, path in all_paths(job):
        resolved = Path(normpath(job.folder.resolve() / path))
        if path.startswith("..") and root not in _ancestors(resolved):
            yield Problem(f"{path} is outside of {root}", job.source.span(place), "use a variable: ${DATA}/…")


def _ancestors(folder: Path) -> list[Path]:
    return [folder.resolve(), *folder.resolve().parents]


CHECK = Check("path-outside", job=check, reads_files=True)
