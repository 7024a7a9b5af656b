"""A task: a job with the state that executors add, its memory budget, and the opening of its recording."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct, structs

from mosaico_ingest.job.model import Job
from mosaico_ingest.remote import with_network
from mosaico_ingest.report.parts import ExpectationResult
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording

DEFAULT_BYTES = 256 << 20
_MIN_BYTES = 32 << 20
_HOLDERS = 4
"""The reader, the write buffer, the sink, and the batch that is being decoded and adapted."""


class Attempt(Struct, frozen=True):
    """An attempt to ingest a recording; a later attempt replaces the sessions of earlier attempts of the same run."""

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


class MemoryBudget(Struct, frozen=True):
    """The number of bytes that the messages and rows of one run may occupy; each stage gets an equal share."""

    total_bytes: int = DEFAULT_BYTES

    @property
    def read_bytes(self) -> int:
        """Bytes for message blocks that are read ahead and sorted."""
        return self.total_bytes // _HOLDERS

    @property
    def queue_bytes(self) -> int:
        """Bytes for batches that wait in the write buffer."""
        return self.total_bytes // _HOLDERS

    @property
    def sink_bytes(self) -> int:
        """Bytes for rows that the sink collects before it writes them."""
        return self.total_bytes // _HOLDERS

    def split(self, runs: int) -> MemoryBudget:
        """Return the budget of one of `runs` simultaneous runs, at least 32 MiB."""
        return MemoryBudget(max(self.total_bytes // runs, _MIN_BYTES))


@contextmanager
def open_job(job: Job) -> Generator[tuple[Recording, TypeResolver]]:
    """Open the recording of a job with the resolver for its message definitions.

    Raises:
        BagError: The recording cannot be opened.
    """
    custom = [(messages.package, Path(messages.path), messages.store) for messages in job.bag.custom_msgs]
    resolver = TypeResolver(job.bag.ros_distro, custom, registry=job.registry or ROSTypeRegistry)
    max_chunk_bytes = job.bag.max_chunk_size or MAX_CHUNK_BYTES
    paths = [with_network(path, job.network.limits) for path in job.paths]
    with open_recording(paths, resolve=resolver, max_chunk_bytes=max_chunk_bytes) as recording:
        yield recording, resolver
