"""`name-clash`: two topics with the same new name.

Each topic of a sequence has its own name; the second one would be refused.

Bad:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu/left: {rename: /imu}
      /imu/right: {rename: /imu}

Good:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu/left: {rename: /imu/l}
      /imu/right: {rename: /imu/r}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each new name that is taken."""
    taken: dict[str, str] = {}
    for topic, setting in job.manifest.topic_settings.items():
        name = (setting.rename or topic).strip("/")
        if name in taken and (setting.rename is not None):
            message = f"{setting.rename!r} is also the name of {taken[name]!r}"
            yield Problem(message, job.span("topic_settings", topic, "rename"), "give each its own name")
        taken.setdefault(name, topic)


RULE = Rule("ING225", __name__, Severity.ERROR, __doc__, job=check)
