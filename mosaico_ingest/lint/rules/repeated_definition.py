"""`repeated-definition`: one message type defined twice.

Two entries of `custom_msgs` define the same type for the same distro; which one is used would depend on their order.

Bad:
    bag:
      path: data/run.mcap
      custom_msgs:
        - {package: acme_msgs, path: msgs}
        - {package: acme_msgs, path: msgs/BatteryPack.msg}

Good:
    bag:
      path: data/run.mcap
      custom_msgs:
        - {package: acme_msgs, path: msgs}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule
from mosaico_ingest.rosbag.definitions.registry import definition_files


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each entry that defines a type an earlier one has defined."""
    first: dict[tuple[str, str | None], int] = {}
    for i, custom in enumerate(job.manifest.bag.custom_msgs):
        files = definition_files(job.resolve(custom.path)) if job.known(custom.path) else ()
        line = job.span("bag", "custom_msgs", i, "path").line
        keys = [(f"{custom.package}/msg/{file.stem}", custom.store and custom.store.value) for file in files]
        repeated = next((key for key in keys if key in first), None)
        if repeated is not None:
            message = f"{repeated[0]} is already defined by the entry of line {first[repeated]}"
            yield Problem(message, job.span("bag", "custom_msgs", i, "path"), "keep one of the two")
        first.update({key: line for key in keys if key not in first})


RULE = Rule("ING218", __name__, Severity.ERROR, __doc__, job=check, disk=True)
