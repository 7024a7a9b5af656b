"""The check of `contradictory-policies`: a topic error policy that never applies."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import DEFAULT_TOPIC, LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report `message: raise` together with a default topic policy that would continue."""
    policies = job.manifest.on_error
    default = policies.topic
    if isinstance(default, dict):
        default = default.get(DEFAULT_TOPIC, TopicLevelErrorPolicy.Raise)
    if policies.message is LoaderErrorPolicy.RAISE and default is not TopicLevelErrorPolicy.Raise:
        message = f"message: raise aborts the run before topic: {default.value} applies"
        yield Problem(message, job.span("on_error", "message"), "set message: log_warn, or topic: raise")


CHECK = Check("contradictory-policies", job=check)
