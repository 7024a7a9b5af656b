"""The check of `name-clash`: two topics with the same name in the sequence."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report each `rename` to the name of another topic in `topic_settings`."""
    topics: dict[str, str] = {}
    for topic, setting in job.manifest.topic_settings.items():
        name = (setting.rename or topic).strip("/")
        if name in topics and setting.rename is not None:
            message = f"{setting.rename!r} is also the name of {topics[name]!r}"
            yield Problem(
                message, job.span("topic_settings", topic, "rename"), "give each topic its own name"
            )
        topics.setdefault(name, topic)


CHECK = Check("name-clash", job=check)
