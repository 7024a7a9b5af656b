"""The check of `topic-name`: a new topic name that the platform rejects."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import SinkError
from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.protocol import check_topic_name


def check(job: Job) -> Iterator[Problem]:
    """Report each `rename` that the platform rejects as a topic name."""
    for topic, setting in job.manifest.topic_settings.items():
        if setting.rename is None or not job.is_expanded(setting.rename):
            continue
        try:
            check_topic_name(setting.rename)
        except SinkError as error:
            span = job.span("topic_settings", topic, "rename")
            yield Problem(error.what, span, "use letters, digits, _ and /")


CHECK = Check("topic-name", job=check)
