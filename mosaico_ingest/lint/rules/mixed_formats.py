"""The check of `mixed-formats`: splits of one recording in different formats."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.containers import SUFFIXES
from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths


def check(job: Job) -> Iterator[Problem]:
    """Report the first split whose suffix differs from the suffix of the first split."""
    splits = [(path, text, Path(text).suffix.lower()) for path, text in recording_paths(job)]
    splits = [split for split in splits if split[2] in SUFFIXES]
    for path, text, suffix in splits[1:]:
        if suffix != splits[0][2]:
            message = f"{text} has another format than {splits[0][1]}"
            yield Problem(message, job.source.span(path), "write two jobs")
            return


CHECK = Check("mixed-formats", job=check)
