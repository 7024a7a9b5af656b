"""The check of a recording against its data contract, without a run: by its index if log times decide the contract."""

from __future__ import annotations

from collections.abc import Mapping

from mosaico_ingest.contracts.clauses import TIME_KEYS, Contract, ReadTopic
from mosaico_ingest.contracts.monitor import RecordingMonitor
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import Unmodeled
from mosaico_ingest.pipeline.opening import open_job
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.contract import ContractResult, ExpectationResult
from mosaico_ingest.rosbag.blocks import Int64s
from mosaico_ingest.rosbag.recording import Recording

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
        has_definitions = all(one.definition is not None for one in recording.connections)
        if has_definitions and needs_times_only(job):
            return _check_times(contract, recording)
        from mosaico_ingest.pipeline.contract_messages import check_messages  # noqa: PLC0415 - log times need no decoder

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
    topics = [ReadTopic(one.topic, (one.id,)) for one in recording.connections]
    monitor = RecordingMonitor(contract, recording, topics)
    ids = [one.id for one in recording.connections if monitor.observer(one.id) is not None]
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
    for key, of_connection in times.items():
        observer = monitor.observer(key)
        if observer is not None:
            observer.block(of_connection)
