"""Groups of recordings of one run: their expectations are evaluated before any of them is ingested."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

from msgspec import structs

from mosaico_ingest.contracts.clauses import Contract
from mosaico_ingest.contracts.evaluate import Member, group_results
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.opening import open_job
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.contract import ExpectationResult
from mosaico_ingest.rosbag.recording import time_bounds


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
