"""The check of `distro-missing`: a `.db3` recording without a ROS distribution."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths


def check(job: Job) -> Iterator[Problem]:
    """Report the first `.db3` file if the manifest does not name a ROS distribution."""
    if job.manifest.bag.ros_distro is not None or job.has("bag", "ros_distro"):
        return
    for path, text in recording_paths(job):
        if text.lower().endswith(".db3"):
            message = f"{text} may not contain message definitions"
            yield Problem(message, job.source.span(path), "add bag.ros_distro, such as ros2_humble")
            return


CHECK = Check("distro-missing", job=check)
