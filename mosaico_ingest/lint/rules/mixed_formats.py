"""`mixed-formats`: parts of different formats in one recording.

A list names the parts of one recording, which one recorder wrote in one format.

Bad:
    bag: {path: [data/part_0.bag, data/part_1.mcap]}

Good:
    bag: {path: [data/part_0.mcap, data/part_1.mcap]}
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for the first part whose suffix differs from the first one's."""
    parts = [(place, path, Path(path).suffix.lower()) for place, path in recording_paths(job)]
    kinds = [(place, path, suffix) for place, path, suffix in parts if suffix in {".bag", ".db3", ".mcap"}]
    for place, path, suffix in kinds[1:]:
        if suffix != kinds[0][2]:
            message = f"{path} is another format than {kinds[0][1]}"
            yield Problem(message, job.source.span(place), "make them two jobs")
            return


RULE = Rule("ING215", __name__, Severity.ERROR, __doc__, job=check)
