"""`excluded-topic`: a setting for a topic that is left out.

`topics` selects what is ingested. A setting, an override or a policy for a topic outside of it has no effect.

Bad:
    bag: {path: data/run.mcap}
    topics: [/camera/*]
    topic_settings:
      /imu: {every: 2}

Good:
    bag: {path: data/run.mcap}
    topics: [/camera/*, /imu]
    topic_settings:
      /imu: {every: 2}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.job.patterns import select
from mosaico_ingest.lint.job import Job, is_glob, keyed_patterns
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each key that is a topic's name and that `topics` does not select."""
    patterns = job.manifest.topics
    if not patterns or not all(job.known(pattern) for pattern in patterns):
        return
    for section, name, span in keyed_patterns(job):
        if not is_glob(name) and not select(patterns, [name]).selected:
            yield Problem(
                f"{section} names {name!r}, which topics leaves out", span, "remove it, or add it to topics"
            )


RULE = Rule("ING222", __name__, Severity.WARNING, __doc__, job=check)
