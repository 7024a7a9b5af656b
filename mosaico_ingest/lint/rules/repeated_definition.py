"""The rule `repeated-definition`: a message type that is defined twice."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.rosbag.definitions.registry import definition_files


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each entry that defines a type an earlier one has defined."""
    first: dict[tuple[str, str | None], int] = {}
    for i, custom in enumerate(job.manifest.bag.custom_msgs):
        files = definition_files(job.resolve(custom.path)) if job.known(custom.path) else ()
        line = job.span("bag", "custom_msgs", i, "path").line
        keys = [(f"{custom.package}/msg/{file.stem}", custom.store and custom.store.value) for file in files]
        repeated = next((key for key in keys if key in first), None)
        if repeated is not None:
            message = f"{repeated[0]} is already defined by the entry of line {first[repeated]}"
            yield Problem(message, job.span("bag", "custom_msgs", i, "path"), "keep one of the two")
        first.update({key: line for key in keys if key not in first})


CHECK = Check("repeated-definition", job=check, reads_files=True)
