"""This file is the whole pipeline in a few functions: compile, plan, run, inspect.

Each imports what only it needs: a short run is over before all of them would be loaded.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.executors.in_process import Inline
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.run import dry_run_report, execute, make_plan
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.report.events import (
    BatchObserver,
    Observer,
    ignore_batch,
    ignore_events,
)
from mosaico_ingest.report.model import Report, RunReport, UsedManifest
from mosaico_ingest.report.timing import Stopwatch
from mosaico_ingest.textfile import read_whole
from mosaico_ingest.version import __version__

if TYPE_CHECKING:
    from mosaico_ingest.executors.in_process import Executor
    from mosaico_ingest.pipeline.plan import Difference, PlanDocument
    from mosaico_ingest.services.inspection import Inspection
    from mosaico_ingest.services.status import RecordingStatus

__all__ = [
    "RosbagInjector",
    "compare_jobs",
    "compile_job",
    "compile_plan",
    "compile_recording",
    "inspect_recording",
    "job_status",
    "plan_differences",
    "plan_job",
    "quick_config",
    "run",
    "used_manifest",
]


class RosbagInjector:
    """Ingests what one configuration names.

    It draws nothing and configures no logging: progress is events, given to `observe`.
    """

    def __init__(self, config: ROSInjectionConfig, *, observe: Observer = ignore_events) -> None:
        self._config = config
        self._observe = observe

    def plan(self) -> Plan:
        """Open the recording and decide everything, without writing.

        Raises:
            IngestError: The job cannot be done; the message says why.
        """
        return make_plan(self._config)

    def run(self) -> Report:
        """Read, adapt and write the recording, and return the report; a dry run writes nothing.

        The report of a dry run names the topics, counts no messages, and has the status `skipped`.

        Raises:
            IngestError: What ended the run; what the session policy keeps is in the destination.
        """
        watch = Stopwatch()
        plan = self.plan()
        if self._config.dry_run:
            return dry_run_report(plan, self._observe)
        report, failure = execute(plan, self._observe, watch=watch)
        if failure is not None:
            raise failure
        return report


def compile_job(manifest: Path) -> tuple[ROSInjectionConfig, ...]:
    """Return the configurations a manifest compiles to, one for each recording.

    Raises:
        ManifestError: Its `findings` say where and what.
        NothingMatched: There is no such recording.
        AdapterError: An adapter it names is not there or has a mistake.
    """
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.pipeline.compile import compile_manifests

    configs = compile_manifests(load_manifests(manifest))
    for _, alike in groupby(configs, key=lambda config: (config.adapters, config.adapter_override)):
        ROSBridge.for_config(next(alike))
    return configs


def compile_recording(manifest: Path, recording: Path) -> tuple[ROSInjectionConfig, ...]:
    """Return the configurations of a manifest for one recording instead of those it names.

    What is in the destination already is skipped where the manifest does not say otherwise.

    Raises:
        IngestError: As `compile_job`.
    """
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.pipeline.compile import compile_manifests

    loaded = (one.for_recording(recording.resolve()) for one in load_manifests(manifest))
    return tuple(
        replace(config, if_exists=IfExists.SKIP) if config.if_exists is IfExists.FAIL else config
        for config in compile_manifests(tuple(loaded))
    )


def plan_job(
    manifest: Path,
    *,
    configs: Sequence[ROSInjectionConfig] | None = None,
    folder: Path | None = None,
    connect: bool = False,
) -> PlanDocument:
    """Return what a manifest would do, tried on the first messages of each topic; writes nothing.

    The document names the manifest as seen from `folder` (the current one). A server is asked only with `connect`.
    `configs` are what the manifest compiles to, where that is done already.

    Raises:
        IngestError: The job cannot be done; the message says why.
    """
    from mosaico_ingest.pipeline.preview import plan_document

    return plan_document(
        configs or compile_job(manifest), job=manifest, folder=folder or Path(), connect=connect
    )


def plan_differences(path: Path, document: PlanDocument) -> tuple[Difference, ...]:
    """Return how a plan file's decisions differ from those of a document.

    Raises:
        ManifestError: The file is no plan.
    """
    from mosaico_ingest.pipeline.plan import differences, read_plan

    known = [recording.decisions for recording in read_plan(path).recordings]
    return differences(known, [recording.decisions for recording in document.recordings])


def compare_jobs(before: Path, after: Path) -> tuple[Difference, ...]:
    """Return what changes in the plan from one manifest to the other.

    Raises:
        IngestError: One of them cannot be done; the message says why.
    """
    from mosaico_ingest.pipeline.plan import differences
    from mosaico_ingest.pipeline.preview import decide

    both = ([decide(config, folder=Path()) for config in compile_job(job)] for job in (before, after))
    return differences(*both)


def compile_plan(path: Path) -> tuple[ROSInjectionConfig, ...]:
    """Return the configurations of a plan file; each runs as planned, or not at all.

    Raises:
        ManifestError: The file is no plan, or its manifest has mistakes.
        IngestError: The manifest or a recording no longer fits the plan; `findings` say how.
    """
    from mosaico_ingest.pipeline.plan import differences, read_plan
    from mosaico_ingest.pipeline.preview import decide

    planned = read_plan(path).recordings
    configs = compile_job(path.parent / read_plan(path).job)
    found = [decide(config, folder=config.base_dir) for config in configs]
    drift = differences([recording.decisions for recording in planned], found)
    if drift:
        raise IngestError(
            f"{len(drift)} decisions are no longer those of the plan; the first: {drift[0]}",
            where=str(path),
            hint="make a new plan with `ingest plan --out`",
            findings=tuple(Finding("plan-drift", Severity.ERROR, str(one)) for one in drift),
        )
    return tuple(
        replace(config, plan_digest=decided.digest) for config, decided in zip(configs, found, strict=True)
    )


def run(
    configs: Sequence[ROSInjectionConfig],
    *,
    executor: Executor | None = None,
    observe: BatchObserver = ignore_batch,
    manifests: Sequence[UsedManifest] = (),
) -> RunReport:
    """Run every configuration, without an `executor` in as many processes as they say; failures are in the report.

    `manifests` are those the configurations come from, for whoever reads the report.
    """
    jobs = configs[0].jobs if configs else 1
    chosen = executor or _executor(jobs)
    return RunReport(
        tool=f"mosaico-ingest {__version__}",
        manifests=tuple(manifests),
        recordings=tuple(chosen.map(configs, observe)),
    )


def _executor(jobs: int) -> Executor:
    if jobs == 1:
        return Inline()
    from mosaico_ingest.executors.processes import Processes

    return Processes(jobs)


def used_manifest(path: Path) -> UsedManifest:
    """Return a manifest for a report: with what it extends, and without secrets.

    Raises:
        ManifestError: It cannot be read.
    """
    from mosaico_ingest.job.expand import manifest_text

    return UsedManifest(path=str(path), text=manifest_text(path))


def job_status(manifest: Path) -> tuple[RecordingStatus, ...]:
    """Return which recordings of a job are done, new, changed or failed; writes nothing.

    Raises:
        IngestError: The manifest cannot become a job.
    """
    from mosaico_ingest.services.status import standings

    return tuple(standings(compile_job(manifest)))


def inspect_recording(path: AnyPath | str, *, ros_distro: str | None = None) -> Inspection:
    """Return what a recording holds and what would become of it.

    Raises:
        BagError: It cannot be opened.
    """
    from mosaico_ingest.services.inspection import inspect

    config = ROSInjectionConfig(file_path=path, sequence_name="inspected", ros_distro=ros_distro)
    return inspect(config)


def quick_config(
    path: AnyPath | str,
    *,
    metadata: str | None,
    api_key: str | None,
    host: str | None,
    **options: Any,  # noqa: ANN401 - the rest of the configuration's fields
) -> ROSInjectionConfig:
    """Return the configuration of `ingest bag`: the same fields as a manifest's.

    Raises:
        ManifestError: An option's value is not what it must be.
    """
    return ROSInjectionConfig(
        file_path=path,
        metadata=_metadata(metadata),
        host=host,
        # The key may come from the environment, which says nothing about where this sequence goes.
        mosaico_api_key=api_key if host else None,
        **options,
    )


def _metadata(given: str | None) -> dict[str, Any]:
    """Read metadata given as JSON, or as the file that holds it."""
    if given is None:
        return {}
    text: str | bytes = given
    where = "--metadata"
    if not given.lstrip().startswith("{"):
        where = given
        try:
            text = read_whole(Path(given))
        except OSError as error:
            raise ManifestError(
                f"is neither a JSON object nor a file that can be read ({error.strerror})",
                where=f"--metadata {given}",
            ) from error
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"is not JSON: {error}", where=where) from error
    if not isinstance(value, dict):
        raise ManifestError(
            f"holds {type(value).__name__}, not an object", where=where, hint='write {"key": "value"}'
        )
    return value
