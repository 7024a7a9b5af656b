"""The rule `missing-definitions`: a path in `custom_msgs` without message definitions."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.rosbag.definitions.registry import definition_files


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each path that does not exist or holds no definition."""
    for i, custom in enumerate(job.manifest.bag.custom_msgs):
        if not job.known(custom.path):
            continue
        path, span = job.resolve(custom.path), job.span("bag", "custom_msgs", i, "path")
        if not path.exists():
            yield Problem(f"{path} is not there", span, "paths start at the manifest's folder")
        elif not definition_files(path):
            yield Problem(f"{path} has no .msg or .idl file", span, "name the directory they are in")


CHECK = Check("missing-definitions", job=check, reads_files=True)
