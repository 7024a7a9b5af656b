"""`relative-topic`: a topic name without its leading slash.

ROS writes topics with their full name. A name or glob without the slash matches none of those, only the rare topic
that a foreign writer recorded without one.

Bad:
    bag: {path: data/run.mcap}
    topics: [imu/data]

Good:
    bag: {path: data/run.mcap}
    topics: [/imu/data]
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, topic_patterns
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each name or glob that starts with a letter."""
    for place, pattern, span in topic_patterns(job):
        bare = pattern.removeprefix("!")
        if bare[:1].isalpha():
            sign = pattern[: len(pattern) - len(bare)]
            yield Problem(f"{pattern!r} in {place} has no leading slash", span, f"write {sign}/{bare}")


RULE = Rule("ING202", __name__, Severity.WARNING, __doc__, job=check)
