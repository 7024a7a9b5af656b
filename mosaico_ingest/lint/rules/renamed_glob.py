"""`renamed-glob`: one new name for all topics of a glob.

A new name is for one topic; all topics that a glob matches cannot have the same.

Bad:
    bag: {path: data/run.mcap}
    topic_settings:
      "/camera/*": {rename: /camera}

Good:
    bag: {path: data/run.mcap}
    topic_settings:
      /camera/front: {rename: /camera}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, is_glob
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each `rename` under a glob."""
    for topic, setting in job.manifest.topic_settings.items():
        if setting.rename is not None and is_glob(topic):
            span = job.key_span("topic_settings", topic, "rename")
            yield Problem(
                f"every topic that {topic!r} matches would be {setting.rename!r}", span, "name one topic"
            )


RULE = Rule("ING224", __name__, Severity.ERROR, __doc__, job=check)
