"""Data contracts without a run: the check of a recording by its log times, and of groups of recordings before any is ingested."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

from msgspec import structs

from mosaico_ingest.contracts import TIME_KEYS, Contract, ReadTopic
from mosaico_ingest.contracts.evaluate import Member, group_results
from mosaico_ingest.contracts.monitor import RecordingMonitor
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import Unmodeled
from mosaico_ingest.lazy import LazySequence
from mosaico_ingest.pipeline.task import Task, open_job
from mosaico_ingest.report.parts import ContractResult, ExpectationResult
from mosaico_ingest.rosbag.blocks import Int64s
from mosaico_ingest.rosbag.recording import Recording, time_bounds

WHOLE_FILE_KEYS = frozenset({"unreadable", "chunk_crcs"})
"""Expectations of the recording that require reading every chunk."""


def check_contract(job: Job, group: tuple[ExpectationResult, ...] = ()) -> ContractResult:
    """Return the results of a job's contract for its recording, without writing.

    `group` has the results of the group that the recording belongs to. Only topics with expectations of their rows are
    decoded. If the contract is only about log times, the index has them, and no message is read.

    Raises:
        ManifestError: The job has no contract, or an expression does not fit the messages of a topic.
        IngestError: The recording cannot be opened or planned.
    """
    contract = Contract.of(job, group)
    if contract is None:
        raise ManifestError(
            "the manifest has no data contract", where=job.origin.file, hint="add the section expect"
        )
    with open_job(job) as (recording, resolver):
        has_definitions = all(connection.definition is not None for connection in recording.connections)
        if has_definitions and needs_times_only(job):
            return _check_times(contract, recording)
        from mosaico_ingest.pipeline.contract import check_messages  # noqa: PLC0415 - log times need no decoder

        return check_messages(Task(job, group=group), recording, resolver)


def needs_times_only(job: Job) -> bool:
    """Return whether log times decide the contract of a job, and every topic would be read completely."""
    contract = Contract.of(job)
    if contract is None:
        return False
    keys = {
        name
        for entry in contract.expect.topics.values()
        for name in entry.model_fields_set - {"severity"}
        if getattr(entry, name) not in (None, {})
    }
    return (
        keys <= TIME_KEYS | {"type"}
        and not any(clause.key in WHOLE_FILE_KEYS for clause in contract.recording_clauses())
        and not (job.topics or job.adapters.load or job.adapters.override)
        and job.adapters.unmodeled is Unmodeled.KEEP
        and (job.bag.time.start, job.bag.time.end) == (None, None)
    )


def _check_times(contract: Contract, recording: Recording) -> ContractResult:
    """Return the results of a contract of log times, without deciding how the messages are converted."""
    topics = [ReadTopic(connection.topic, (connection.id,)) for connection in recording.connections]
    monitor = RecordingMonitor(contract, recording, topics)
    ids = [
        connection.id for connection in recording.connections if monitor.observer(connection.id) is not None
    ]
    times = recording.index_times(ids)
    if times is not None:
        add_times(monitor, times)
    else:
        for block in recording.message_blocks(ids):
            observer = monitor.observer(block.connection)
            if observer is not None:
                observer.block(block.log_times)
    return monitor.finish()


def add_times(monitor: RecordingMonitor, times: Mapping[int, Int64s]) -> None:
    """Add all log times of some connections."""
    for connection, log_times in times.items():
        observer = monitor.observer(connection)
        if observer is not None:
            observer.block(log_times)


def add_group_results(tasks: Sequence[Task], present: Callable[[], Sequence[Job]] = tuple) -> list[Task]:
    """Return the tasks with the results of the expectations of their groups.

    `present` returns the jobs of further recordings of the groups; it is only called if a group has expectations.
    """
    jobs = [task.job for task in tasks]
    if any(job.expect is not None and job.expect.group is not None for job in jobs):
        jobs += present()
    results = results_by_job(jobs)
    return [
        structs.replace(task, group=results[position]) if position in results else task
        for position, task in enumerate(tasks)
    ]


def results_by_job(jobs: Sequence[Job]) -> dict[int, tuple[ExpectationResult, ...]]:
    """Return the results of the group of each job, by position, for the jobs that have expectations of their group."""
    if not any(
        job.expect is not None and job.expect.group is not None for job in LazySequence.of(jobs).samples
    ):
        return {}
    groups: dict[tuple[object, ...], list[int]] = defaultdict(list)
    for position, job in enumerate(jobs):
        if job.expect is not None and job.expect.group is not None:
            folder = job.paths[0].parent if job.expect.group.by == "folder" else None
            groups[job.origin.file, job.expect.group.model_dump_json(), str(folder)].append(position)
    results: dict[int, tuple[ExpectationResult, ...]] = {}
    for positions in groups.values():
        contract = Contract.of(jobs[positions[0]])
        if contract is not None:
            members = [_member(jobs[position]) for position in positions]
            results.update(dict.fromkeys(positions, group_results(contract, members)))
    return results


def _member(job: Job) -> Member:
    """Return the files and the time span of a recording; the times are None if it cannot be opened."""
    names = tuple(dict.fromkeys(path.name for path in job.paths))
    try:
        with open_job(job) as (recording, _):
            start_ns, end_ns = time_bounds(recording)
            is_empty = recording.start_ns is None and start_ns == end_ns == 0
    except IngestError:  # the run of the recording reports the error
        return Member(names)
    return Member(names) if is_empty else Member(names, start_ns, end_ns)
