"""The rule `distro-missing`: a `.db3` recording without a ROS distribution."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if a part is a `.db3` file and neither a distro nor definitions are named."""
    bag = job.manifest.bag
    if bag.ros_distro is not None or job.given("bag", "ros_distro"):
        return
    for place, path in recording_paths(job):
        if path.lower().endswith(".db3"):
            yield Problem(
                f"{path} may carry no definitions",
                job.source.span(place),
                "add bag.ros_distro, as ros2_humble",
            )
            return


CHECK = Check("distro-missing", job=check)
