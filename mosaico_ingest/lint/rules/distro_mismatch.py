"""`distro-mismatch`: a distro of the other ROS.

A `.bag` file is ROS 1 and a `.db3` file ROS 2; the definitions of the other one do not fit their messages.

Bad:
    bag: {path: data/run.bag, ros_distro: ros2_humble}

Good:
    bag: {path: data/run.bag, ros_distro: ros1_noetic}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Problem, Rule

_VERSIONS = {".bag": "ros1", ".db3": "ros2"}


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the suffix and the distro disagree about the ROS version."""
    distro = job.manifest.bag.ros_distro
    if distro is None or not distro.value.startswith("ros"):
        return
    for _, path in recording_paths(job):
        version = _VERSIONS.get(path[-4:].lower())
        if version is not None and not distro.value.startswith(version) and not job.resolve(path).is_dir():
            message = f"{path} is a {version.upper()} recording, {distro.value} is not"
            yield Problem(message, job.span("bag", "ros_distro"), f"name a {version} distro, or none")
            return


RULE = Rule("ING213", __name__, Severity.WARNING, __doc__, job=check)
