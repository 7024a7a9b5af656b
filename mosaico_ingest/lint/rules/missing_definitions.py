"""The check of `missing-definitions`: a path in `custom_msgs` without message definitions."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.rosbag.definitions.registry import definition_files


def check(job: Job) -> Iterator[Problem]:
    """Report each path in `custom_msgs` that does not exist or contains no definition."""
    for i, custom in enumerate(job.manifest.bag.custom_msgs):
        if not job.is_expanded(custom.path):
            continue
        path, span = job.resolve(custom.path), job.span("bag", "custom_msgs", i, "path")
        if not path.exists():
            hint = "correct the path; it starts at the manifest's folder"
            yield Problem(f"{path} does not exist", span, hint)
        elif not definition_files(path):
            yield Problem(f"{path} contains no .msg or .idl file", span, "name the directory of the files")


CHECK = Check("missing-definitions", job=check, reads_files=True)
