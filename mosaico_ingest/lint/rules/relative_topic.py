"""The check of `relative-topic`: a topic name without a leading slash."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import nearest
from mosaico_ingest.job.values import DEFAULT_TOPIC
from mosaico_ingest.lint.check import Check, Job, Problem, topic_patterns


def check(job: Job) -> Iterator[Problem]:
    """Report each topic name or glob that starts with a letter."""
    for section, pattern, span in topic_patterns(job):
        name = pattern.removeprefix("!")
        if name[:1].isalpha():
            sign = pattern[: len(pattern) - len(name)]
            hint = f"write {sign}/{name}"
            if section == "on_error.topic" and nearest(name, [DEFAULT_TOPIC]):
                hint = f"did you mean {DEFAULT_TOPIC}? otherwise {hint}"
            yield Problem(f"{pattern!r} in {section} has no leading slash", span, hint)


CHECK = Check("relative-topic", job=check)
