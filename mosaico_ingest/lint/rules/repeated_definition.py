"""The check of `repeated-definition`: a message type that is defined twice."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.rosbag.definitions.registry import definition_files


def check(job: Job) -> Iterator[Problem]:
    """Report each entry of `custom_msgs` that defines a type that an earlier entry defines for the same distribution."""
    lines: dict[tuple[str, str | None], int] = {}
    for i, custom in enumerate(job.manifest.bag.custom_msgs):
        files = definition_files(job.resolve(custom.path)) if job.is_expanded(custom.path) else ()
        span = job.span("bag", "custom_msgs", i, "path")
        distro = None if custom.store is None else custom.store.value
        types = [(f"{custom.package}/msg/{file.stem}", distro) for file in files]
        repeated = next((type_ for type_ in types if type_ in lines), None)
        if repeated is not None:
            message = f"the entry in line {lines[repeated]} already defines {repeated[0]}"
            yield Problem(message, span, "keep one of the two entries")
        lines = {**dict.fromkeys(types, span.line), **lines}


CHECK = Check("repeated-definition", job=check, reads_files=True)
