"""`topic-name`: a new topic name the platform refuses.

Topic names go into paths and queries: words between single slashes, ASCII, no blank, none of ``! " ' * $ % & . :``.

Bad:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu: {rename: "/sensors/imu.raw"}

Good:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu: {rename: /sensors/imu_raw}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule
from mosaico_ingest.protocol import check_topic_name


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each `rename` that cannot be a topic's name."""
    for topic, setting in job.manifest.topic_settings.items():
        if setting.rename is None or not job.known(setting.rename):
            continue
        try:
            check_topic_name(setting.rename)
        except SinkError as error:
            yield Problem(
                error.what, job.span("topic_settings", topic, "rename"), "use letters, digits, _ and /"
            )


RULE = Rule("ING223", __name__, Severity.ERROR, __doc__, job=check)
