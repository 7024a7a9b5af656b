"""The check of `distro-mismatch`: a ROS distribution of the other ROS version."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.containers import ROS_VERSIONS
from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths

_VERSIONS = {suffix: f"ros{versions[0]}" for suffix, versions in ROS_VERSIONS.items() if len(versions) == 1}
"""The ROS version of containers that store only one."""


def check(job: Job) -> Iterator[Problem]:
    """Report a ROS distribution whose ROS version differs from the version that the recording's suffix implies."""
    distro = job.manifest.bag.ros_distro
    if distro is None or not distro.value.startswith("ros"):
        return
    for _, text in recording_paths(job):
        version = _VERSIONS.get(Path(text).suffix.lower())
        if version is not None and not distro.value.startswith(version) and not job.resolve(text).is_dir():
            message = f"{text} is a {version.upper()} recording, and {distro.value} is not a {version.upper()} distribution"
            yield Problem(
                message, job.span("bag", "ros_distro"), f"name a {version} distribution, or remove the key"
            )
            return


CHECK = Check("distro-mismatch", job=check)
