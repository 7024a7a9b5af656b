"""The check of `renamed-glob`: one new name for all topics that a glob matches."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import is_glob
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report each `rename` under a glob."""
    for topic, setting in job.manifest.topic_settings.items():
        if setting.rename is not None and is_glob(topic):
            span = job.key_span("topic_settings", topic, "rename")
            message = f"all topics that {topic!r} matches would be named {setting.rename!r}"
            yield Problem(message, span, "name a single topic instead of a glob")


CHECK = Check("renamed-glob", job=check)
