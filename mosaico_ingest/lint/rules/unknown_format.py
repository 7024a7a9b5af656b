"""The check of `unknown-format`: a recording with an unknown file name extension."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.containers import RECORDING_NAME, SUFFIX_LIST
from mosaico_ingest.job.values import is_glob
from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths


def check(job: Job) -> Iterator[Problem]:
    """Report each file whose suffix is not the suffix of a recording."""
    for path, text in recording_paths(job):
        suffix = Path(text).suffix
        is_recording = RECORDING_NAME.search(text) or text.lower().endswith("metadata.yaml")
        if suffix and not is_glob(suffix) and not is_recording and not job.resolve(text).is_dir():
            hint = f"name a recording ({SUFFIX_LIST}), or a rosbag2 directory"
            yield Problem(f"{text} does not look like a recording", job.source.span(path), hint)


CHECK = Check("unknown-format", job=check)
