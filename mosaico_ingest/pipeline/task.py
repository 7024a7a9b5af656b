"""A job together with the state that executors add to it."""

from __future__ import annotations

from pathlib import Path

from msgspec import Struct, structs

from mosaico_ingest.job.model import Job
from mosaico_ingest.report.contract import ExpectationResult


class Attempt(Struct, frozen=True):
    """An attempt to ingest a recording; a later attempt replaces what an earlier attempt of the same run committed."""

    run: str
    """The id of the run."""
    number: int = 1


class Task(Struct, frozen=True):
    """A job to run, and the conditions that an executor runs it under."""

    job: Job
    plan_digest: str | None = None
    """The digest of the only plan that may run; None for any plan."""
    attempt: Attempt | None = None
    known: bool = False
    """Whether the same content is stored already, ingested by the same job: the run skips it without opening it."""
    dry_run: bool = False
    """Whether to plan only, and write nothing."""
    group: tuple[ExpectationResult, ...] = ()
    """The results of the expectations of the recordings that belong together (`expect.group`)."""
    code_dir: Path | None = None
    """The folder where the relative paths of adapters start on a machine that they were shipped to."""

    def with_log_level(self, level: str) -> Task:
        """Return the task with another log level."""
        run = self.job.run.replace(log_level=level.upper())
        return structs.replace(self, job=self.job.replace(run=run))

    @property
    def adapter_folder(self) -> Path:
        """The folder where the relative paths of adapters start."""
        return self.job.folder if self.code_dir is None else self.code_dir
