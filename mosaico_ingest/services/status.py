"""This file says where a job's recordings stand: held against what the provenances of the destination know."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum

from msgspec import Struct

from mosaico_ingest.errors import IngestError, SequenceExists
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.pipeline.provenance import (
    certain,
    held,
    provenance_of,
    what_to_do,
)
from mosaico_ingest.pipeline.run import make_plan

__all__ = ["RecordingStatus", "Standing", "standings"]


class Standing(str, Enum):
    """What a run with `if_exists: skip` would find."""

    DONE = "done"
    """The same content is there, made by the same job."""
    NEW = "new"
    """There is no sequence of its name."""
    CHANGED = "changed"
    """What is there was made from other content, or by another job."""
    FAILED = "failed"
    """The same content is there in part: an error ended its run."""
    UNREADABLE = "unreadable"
    """The recording cannot be opened, or the job does not fit it."""


class RecordingStatus(Struct, frozen=True):
    """One recording: what it becomes, how it stands, and why where that is not plain."""

    sequence: str
    files: tuple[str, ...]
    standing: Standing
    why: str = ""


def standings(configs: Iterable[ROSInjectionConfig]) -> Iterator[RecordingStatus]:
    """Look into each recording and its destination; nothing is written."""
    for config in configs:
        standing, why = _standing(config)
        yield RecordingStatus(config.sequence_name, tuple(map(str, config.paths)), standing, why)


def _standing(config: ROSInjectionConfig) -> tuple[Standing, str]:
    try:
        plan = make_plan(config)
        found = held(plan.target, plan.sequence)
        if found is None:
            return Standing.NEW, ""
        decided = what_to_do(certain(provenance_of(plan), plan.files, found), found, plan.sequence)
    except SequenceExists as error:
        return Standing.CHANGED, error.what
    except IngestError as error:
        return Standing.UNREADABLE, str(error)
    if decided is IfExists.REPLACE:
        return Standing.FAILED, "an error ended the run that made it"
    return Standing.DONE, ""
