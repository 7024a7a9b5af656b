"""The rule `distro-mismatch`: a ROS distribution of the other ROS version."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Check, Problem

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


CHECK = Check("distro-mismatch", job=check)
