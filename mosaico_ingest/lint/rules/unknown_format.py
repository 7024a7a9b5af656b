"""The rule `unknown-format`: a recording with an unknown file name extension."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.lint.job import Job, is_glob, recording_paths
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.rosbag.formats import RECORDING_NAME


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each part with the suffix of something else."""
    for place, path in recording_paths(job):
        suffix = Path(path).suffix
        known = RECORDING_NAME.search(path) or path.lower().endswith("metadata.yaml")
        if suffix and not is_glob(suffix) and not known and not job.resolve(path).is_dir():
            remedy = "recordings are .bag, .db3 and .mcap files, and rosbag2 directories"
            yield Problem(f"{path} does not look like a recording", job.source.span(place), remedy)


CHECK = Check("unknown-format", job=check)
