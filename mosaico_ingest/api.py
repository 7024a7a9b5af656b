"""The public Python API, in the order of the pipeline.

`compile_job` turns a manifest into jobs, one per recording. `plan_job` previews them. `run` chooses an executor, which
calls `pipeline.run.run_recording` for every recording:

    open → plan → check provenance → open the sink → pump (decode, adapt, write) → verify → report

Functions import what only they need, because a short run would otherwise spend more time on imports than on work.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.lazy import LazySequence
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.remote import AnyPath, as_path
from mosaico_ingest.report.events import BatchObserver, Observer, ignore_batch, ignore_events
from mosaico_ingest.report.recording import Report
from mosaico_ingest.report.run import RunReport, UsedManifest
from mosaico_ingest.version import __version__

if TYPE_CHECKING:
    from mosaico_ingest.executors import Executor
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.pipeline.plan import Plan
    from mosaico_ingest.pipeline.plan_document import Difference, PlanDocument, RecordingPlan
    from mosaico_ingest.services.check import Checked
    from mosaico_ingest.services.inspection import Inspection
    from mosaico_ingest.services.status import RecordingStatus

__all__ = [
    "RosbagInjector",
    "check",
    "compare_jobs",
    "compile_job",
    "compile_plan",
    "compile_recording",
    "inspect_recording",
    "job_status",
    "plan_job",
    "plan_recordings",
    "quick_config",
    "run",
    "used_manifest",
]


class RosbagInjector:
    """Ingests the recording of one configuration.

    It prints nothing and configures no logging; `observe` receives the events of the run.
    """

    def __init__(self, config: ROSInjectionConfig, *, observe: Observer = ignore_events) -> None:
        self._config = config
        self._observe = observe

    def plan(self) -> Plan:
        """Open the recording and decide everything, without writing.

        Raises:
            IngestError: The configuration does not fit the recording.
        """
        from mosaico_ingest.pipeline.run import make_plan

        return make_plan(Task(self._config.job))

    def run(self) -> Report:
        """Read, adapt and write the recording, and return the report; a dry run writes nothing.

        The report of a dry run names the topics, counts no messages, and has the status `skipped`.

        Raises:
            ManifestError: The configuration splits the recording into several sequences.
            IngestError: The run failed or was interrupted. The session policy decides which rows were kept.
        """
        from mosaico_ingest.pipeline.run import run_recording

        if self._config.job.split is not None:
            raise ManifestError(
                "split makes several sequences", where="manifest['split']", hint="use api.run([config])"
            )
        outcome = run_recording(Task(self._config.job, dry_run=self._config.dry_run), self._observe)
        if outcome.error is not None:
            raise outcome.error
        return outcome.report


def compile_job(manifest: Path, *, locked: bool = True) -> LazySequence[Job]:
    """Return the jobs of a manifest, one for each recording; `locked=False` does not read the lock file.

    A job is built when it is accessed, so a manifest may select any number of recordings.

    Raises:
        ManifestError: The manifest has mistakes; `findings` has their locations.
        NothingMatched: `bag.path` matches no recording.
        AdapterError: An adapter of the manifest does not exist or has a mistake.
    """
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.pipeline.compile import compile_manifests

    jobs = compile_manifests(load_manifests(manifest), locked=locked)
    for adapters, group in groupby(jobs.samples, key=lambda job: job.adapters):
        if adapters.load or adapters.override:
            from mosaico_ingest.pipeline.adapter_check import check_adapters

            check_adapters(next(group))
    return jobs


def compile_recording(manifest: Path, recording: AnyPath) -> tuple[Job, ...]:
    """Return the jobs of a manifest for one recording instead of those of `bag.path`.

    `if_exists: fail`, the default, becomes `skip`, so that a recording may be submitted again.

    Raises:
        IngestError: As `compile_job`.
    """
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.pipeline.compile import compile_manifests

    manifests = tuple(loaded.for_recording(recording.resolve()) for loaded in load_manifests(manifest))
    return tuple(map(_skipping, compile_manifests(manifests)))


def _skipping(job: Job) -> Job:
    """Return a job that compares an existing sequence with the recording instead of failing."""
    if job.sequence.if_exists is not IfExists.FAIL:
        return job
    return job.replace(sequence=job.sequence.replace(if_exists=IfExists.SKIP))


def quick_config(
    path: AnyPath | str,
    *,
    sequence_name: str | None = None,
    metadata: str | None = None,
    topic_metadata: str | None = None,
    api_key: str | None = None,
    host: str | None = None,
    if_exists: IfExists = IfExists.FAIL,
    **options: Any,  # noqa: ANN401 - the rest of the configuration's fields
) -> ROSInjectionConfig:
    """Return the configuration of `ingest bag`; `sequence_name` defaults to the name of the file without suffix.

    `metadata` and `topic_metadata` are JSON objects or paths of JSON files.

    Raises:
        ManifestError: An option has an invalid value.
    """
    from mosaico_ingest.job.config import ROSInjectionConfig

    if sequence_name is None:
        from mosaico_ingest.services.inspection import default_name

        sequence_name = default_name(as_path(path) if isinstance(path, str) else path)
    return ROSInjectionConfig(
        file_path=path,
        sequence_name=sequence_name,
        metadata=_read_json_object(metadata, "--metadata"),
        topic_metadata=_read_topic_metadata(topic_metadata),
        host=host,
        # The key may come from the environment, where it does not select a server.
        mosaico_api_key=api_key if host else None,
        manifest=None if if_exists is IfExists.FAIL else {"sequence": {"if_exists": if_exists}},
        **options,
    )


def inspect_recording(path: AnyPath | str, *, ros_distro: str | None = None) -> Inspection:
    """Return the content of a recording according to its index, with the adapter of each topic.

    Raises:
        BagError: The recording cannot be opened.
    """
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.services.inspection import inspect

    config = ROSInjectionConfig(file_path=path, sequence_name="inspected", ros_distro=ros_distro)
    return inspect(config.job)


def check_recordings(manifest: Path, *, jobs: Sequence[Job] | None = None) -> Iterator[Checked]:
    """Yield the results of the data contract of a manifest for each of its recordings; write nothing.

    `jobs` avoids compiling the manifest a second time.

    Raises:
        IngestError: The manifest cannot be compiled.
    """
    from mosaico_ingest.services.check import check_jobs

    return check_jobs(jobs or compile_job(manifest))


def check(manifest: Path | str) -> tuple[Checked, ...]:
    """Return the result of the data contract for each recording of a manifest; write nothing.

    Raises:
        IngestError: The manifest cannot be compiled.
    """
    return tuple(check_recordings(Path(manifest)))


def check_sequence(store: str, sequence: str, expect: Path) -> Checked:
    """Return the results of the section `expect` of a file for a stored sequence.

    Raises:
        ManifestError: The file has mistakes, or no section `expect`.
        SinkError: The store does not exist or has no such sequence.
    """
    from mosaico_ingest.services.check import check_sequence as check

    return check(store, sequence, expect)


def plan_recordings(
    manifest: Path | str, *, jobs: Sequence[Job] | None = None, connect: bool = False
) -> Iterator[RecordingPlan]:
    """Yield the plan of each recording of a manifest with the result of a sample of each topic; write nothing.

    A server is contacted only with `connect`. `jobs` avoids compiling the manifest a second time.

    Raises:
        IngestError: Recordings cannot be planned; raised after the plans of the others.
    """
    from mosaico_ingest.pipeline.preview import plan_recordings

    return plan_recordings(jobs or compile_job(Path(manifest)), connect=connect)


def plan_job(
    manifest: Path | str,
    *,
    jobs: Sequence[Job] | None = None,
    folder: Path | None = None,
    connect: bool = False,
) -> PlanDocument:
    """Return the plans of all recordings of a manifest as one document; see `plan_recordings`.

    Paths in the document are relative to `folder` (default: the current directory).

    Raises:
        IngestError: A recording cannot be planned.
    """
    from mosaico_ingest.pipeline.preview import plan_frame

    recordings = tuple(plan_recordings(manifest, jobs=jobs, connect=connect))
    return plan_frame(Path(manifest), folder or Path()).replace(recordings=recordings)


def compare_jobs(before: Path, after: Path) -> tuple[Difference, ...]:
    """Return the differences between the plans of two manifests.

    Raises:
        IngestError: A recording of one of them cannot be planned.
    """
    from mosaico_ingest.pipeline.plan_document import differences
    from mosaico_ingest.pipeline.run import make_plan

    plans = (
        [make_plan(Task(job)).document(folder=Path()) for job in compile_job(manifest)]
        for manifest in (before, after)
    )
    return differences(*plans)


def compile_plan(path: Path) -> tuple[Task, ...]:
    """Return the tasks of a plan file; each runs exactly as planned or fails.

    Raises:
        ManifestError: The file is not a plan, or its manifest has mistakes.
        IngestError: The manifest or a recording no longer fits the plan; `findings` has the differences.
    """
    from mosaico_ingest.pipeline.plan import digest_of
    from mosaico_ingest.pipeline.plan_document import differences, read_plan
    from mosaico_ingest.pipeline.run import make_plan

    document = read_plan(path)
    jobs = compile_job(path.parent / document.job)
    current = [make_plan(Task(job)).document(folder=job.folder) for job in jobs]
    drift = differences([recording.plan for recording in document.recordings], current)
    if drift:
        raise IngestError(
            f"{len(drift)} decisions differ from the plan; the first: {drift[0]}",
            where=str(path),
            hint="make a new plan with `ingest plan --out`",
            findings=tuple(Finding("plan-drift", Severity.ERROR, str(one)) for one in drift),
        )
    return tuple(Task(job, plan_digest=digest_of(plan)) for job, plan in zip(jobs, current, strict=True))


def run(
    jobs: Path | str | Sequence[Job | Task | ROSInjectionConfig],
    *,
    executor: Executor | None = None,
    observe: BatchObserver = ignore_batch,
    manifests: Sequence[UsedManifest] = (),
    verify: bool = False,
    report: Path | None = None,
    resume: bool = False,
) -> RunReport:
    """Run a manifest, or every job of a list, and return the report; a failed recording is part of the report.

    The default executor runs as many recordings at a time as `run.jobs` of the first job. `manifests` are added to
    the report for its readers; a manifest that is run is added by itself. With `if_exists: skip`, stored recordings whose
    files and job have not changed are not opened; `verify` opens them and compares their content.

    `report` is a file in JSON Lines (`.jsonl`) to which each recording is appended when it ends. The recordings of the
    result are then read from this file at each access, so that their number does not determine the memory. With `resume`,
    the run continues the report of an earlier run: recordings that it finished and that have not changed are skipped and
    keep their lines. Sequences that exist are compared, as with `if_exists: skip`, instead of failing.

    Raises:
        ManifestError: The manifest has mistakes, or the file to continue is not a report.
        NothingMatched: The manifest matches no recording.
        SinkError: The report cannot be written.
    """
    if isinstance(jobs, str | Path):
        manifests = (*manifests, used_manifest(Path(jobs)))
        jobs = compile_job(Path(jobs))
    tasks = _tasks(jobs)
    if any(task.job.expect is not None and task.job.expect.group is not None for task in tasks.samples):
        from mosaico_ingest.pipeline.contract_check import add_group_results

        tasks = LazySequence.of(add_group_results(tasks))
    from mosaico_ingest.pipeline.provenance import mark_known

    if executor is None:
        from mosaico_ingest.executors import choose_executor

        executor = choose_executor(tasks)
    tool = f"mosaico-ingest {__version__}"
    if report is None:
        recordings = tuple(executor.map(tasks if verify else mark_known(tasks), observe))
        return RunReport(tool=tool, manifests=tuple(manifests), recordings=recordings)
    from mosaico_ingest.report.run import Header, ReportWriter

    if resume:
        _refuse_shared_lines(tasks)
    with ReportWriter(report, Header(tool=tool, manifests=tuple(manifests)), resume=resume) as writer:
        if resume:
            tasks = tasks.map(_skipping_task)
        candidates = tasks if verify else mark_known(tasks, writer.has_finished if resume else None)
        for recording in executor.map(candidates, observe):
            writer.add(recording)
        return writer.finish()


def _refuse_shared_lines(tasks: LazySequence[Task]) -> None:
    """Raise ManifestError if several manifests write a sequence, whose recordings would share a line of the report."""
    if len(tasks.samples) < 2:  # noqa: PLR2004 - the names of one manifest differ
        return
    from mosaico_ingest.destinations import destination_of

    keys: set[tuple[str, str]] = set()
    for job in (task.job for task in tasks):
        key = (job.sequence.name, destination_of(job.destination).describe())
        if key in keys:
            raise ManifestError(
                f"several recordings of the run write the sequence {job.sequence.name!r}",
                where=job.origin.file,
                hint="resume each manifest with a report of its own, because a report resumes by sequence",
            )
        keys.add(key)


def _tasks(jobs: Sequence[Job | Task | ROSInjectionConfig]) -> LazySequence[Task]:
    """Return the task of each job, or one task for each part if a configuration splits its recording."""
    if isinstance(jobs, LazySequence):  # of a manifest, whose recordings are split already
        return jobs.map(_task)
    return LazySequence.of([part for job in jobs for part in _parts_of(job)])


def _parts_of(job: Job | Task | ROSInjectionConfig) -> Iterator[Task]:
    if isinstance(job, Task):
        yield job
    elif isinstance(job, Job):
        yield from map(Task, _parts(job))
    else:
        yield from (Task(part, dry_run=job.dry_run) for part in _parts(job.job))


def _task(job: Job | Task | ROSInjectionConfig) -> Task:
    (task,) = _parts_of(job)
    return task


def _skipping_task(task: Task) -> Task:
    return structs.replace(task, job=_skipping(task.job))


def _parts(job: Job) -> tuple[Job, ...]:
    if job.split is None:
        return (job,)
    from mosaico_ingest.pipeline.split import split_job

    return split_job(job)


def used_manifest(path: Path) -> UsedManifest:
    """Return a manifest for a report, with `extends` resolved and without secrets.

    Raises:
        ManifestError: The manifest cannot be read.
    """
    from mosaico_ingest.job.reference import manifest_text

    return UsedManifest(path=str(path), text=manifest_text(path))


def job_status(manifest: Path, *, verify: bool = False) -> tuple[RecordingStatus, ...]:
    """Return which recordings of a manifest are done, new, changed, failed or unreadable; write nothing.

    Stored recordings whose files and job have not changed are not opened; `verify` opens them and compares their content.

    Raises:
        IngestError: The manifest cannot be compiled.
    """
    from mosaico_ingest.services.status import recording_statuses

    return tuple(recording_statuses(compile_job(manifest), verify=verify))


def _read_topic_metadata(argument: str | None) -> dict[str, dict[str, Any]]:
    topics = _read_json_object(argument, "--topic-metadata")
    for topic, metadata in topics.items():
        if not isinstance(metadata, dict):
            raise ManifestError(
                f"the value of {topic!r} is not an object",
                where="--topic-metadata",
                hint='write {"/topic": {"key": "value"}}',
            )
    return topics


def _read_json_object(argument: str | None, option: str) -> dict[str, Any]:
    """Return the value of an option that takes a JSON object or the path of a JSON file."""
    if argument is None:
        return {}
    text: str | bytes = argument
    where = option
    if not argument.lstrip().startswith("{"):
        where = argument
        try:
            text = read_limited(Path(argument))
        except OSError as error:
            raise ManifestError(
                f"is neither a JSON object nor a readable file ({error.strerror})",
                where=f"{option} {argument}",
            ) from error
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"is not JSON: {error}", where=where) from error
    if not isinstance(value, dict):
        raise ManifestError("the JSON value is not an object", where=where, hint='write {"key": "value"}')
    return value
