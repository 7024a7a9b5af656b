"""`contradictory-policies`: error policies that work against each other.

`message: raise` ends the run at the first message that cannot be read. A topic policy that would go on, `ignore` or
`finalize`, then never sees the most common error of all.

Bad:
    bag: {path: data/run.mcap}
    on_error: {message: raise, topic: ignore}

Good:
    bag: {path: data/run.mcap}
    on_error: {message: log_warn, topic: ignore}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import DEFAULT_TOPIC, LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if messages raise and all topics are to go on."""
    policies = job.manifest.on_error
    default = policies.topic
    if isinstance(default, dict):
        default = default.get(DEFAULT_TOPIC, TopicLevelErrorPolicy.Raise)
    if policies.message is LoaderErrorPolicy.RAISE and default is not TopicLevelErrorPolicy.Raise:
        message = f"message: raise ends the run before topic: {default.value} is asked"
        yield Problem(message, job.span("on_error", "message"), "say log_warn, or topic: raise")


RULE = Rule("ING230", __name__, Severity.WARNING, __doc__, job=check)
