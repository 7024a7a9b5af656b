"""Dagster assets: one per recording of a manifest, with metadata, and asset checks from its data contract.

Run it from the folder of the repository:

    INGEST_MANIFEST=configs/examples/contract.yaml dagster dev -f configs/integrations/dagster_recordings.py
"""

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import dagster as dg

from mosaico_ingest import IfExists, run
from mosaico_ingest.api import compile_job
from mosaico_ingest.job.model import Job
from mosaico_ingest.report.parts import ContractResult, ExpectationResult
from mosaico_ingest.report.recording import Report

RECORDING = "recording"
"""The check of the expectations that concern the complete recording."""


def checks_of(job: Job) -> dict[str, str]:
    """Return the name of each asset check by the key path of its expectations: one per key of `expect.topics`."""
    if job.expect is None:
        return {}
    return {
        "expect": RECORDING,
        **{f"expect.topics.{pattern}": name_of(f"topic_{pattern}") for pattern in job.expect.topics},
    }


def name_of(text: str) -> str:
    """Return a name that Dagster accepts."""
    return re.sub(r"[\W_]+", "_", text.replace("*", "any")).strip("_")


def recording_asset(job: Job) -> dg.AssetsDefinition:
    """Return the asset of one recording: its sequence, which a new materialization replaces."""
    checks = checks_of(job)
    replacing = job.replace(sequence=job.sequence.replace(if_exists=IfExists.REPLACE))
    name = name_of(job.sequence.name)

    @dg.asset(
        name=name,
        group_name="recordings",
        kinds={"mosaico"},
        description=f"The sequence {job.sequence.name} from {', '.join(path.name for path in job.paths)}",
        check_specs=[dg.AssetCheckSpec(check, asset=name) for check in checks.values()],
        output_required=False,
    )
    def ingest(context: dg.AssetExecutionContext) -> Iterator[dg.AssetCheckResult | dg.MaterializeResult]:
        (report,) = run([replacing]).recordings
        if report.contract is not None:
            for path, check in checks.items():
                yield check_result(check, expectations_below(path, report.contract, checks))
        if report.error is not None:
            raise dg.Failure(report.error, metadata={"exit_code": report.exit_code})
        context.log.info("stored %s in %s", report.sequence, report.destination)
        yield dg.MaterializeResult(metadata=metadata_of(report))

    return ingest


def expectations_below(path: str, contract: ContractResult, paths: Iterable[str]) -> list[ExpectationResult]:
    """Return the results of the expectations for which `path` is the longest matching key path in `paths`."""

    def longest(result: ExpectationResult) -> str:
        return max((one for one in paths if result.expectation.startswith(f"{one}.")), key=len)

    return [result for result in contract.results if longest(result) == path]


def check_result(name: str, results: list[ExpectationResult]) -> dg.AssetCheckResult:
    """Return the result of a check; only a failed expectation with the severity `error` is an error."""
    failed = [result for result in results if not result.passed]
    is_error = any(result.severity.value == "error" for result in failed)
    return dg.AssetCheckResult(
        check_name=name,
        passed=not failed,
        severity=dg.AssetCheckSeverity.ERROR if is_error else dg.AssetCheckSeverity.WARN,
        description="\n".join(result.line for result in failed) or None,
        metadata={result.line.partition(";")[0]: result.outcome.value for result in results},
    )


def metadata_of(report: Report) -> dict[str, dg.MetadataValue]:
    """Return the metadata of a materialization: counts, sizes and one row per topic."""
    topics = [topic for topic in report.topics if topic.written]
    columns = ("topic", "type", "ontology", "messages", "rejected")
    rows = [
        (topic.target, topic.msgtype, topic.ontology or "", topic.written, topic.rejected) for topic in topics
    ]
    return {
        "dagster/row_count": dg.MetadataValue.int(sum(topic.written for topic in topics)),
        "dagster/uri": dg.MetadataValue.text(f"{report.destination}/{report.sequence}"),
        "status": dg.MetadataValue.text(report.status.value),
        "source_bytes": dg.MetadataValue.int(report.source_bytes or 0),
        "duration_s": dg.MetadataValue.float(report.duration_s),
        "topics": dg.MetadataValue.table(
            [dg.TableRecord(dict(zip(columns, row, strict=True))) for row in rows]
        ),
    }


MANIFEST = Path(os.environ.get("INGEST_MANIFEST", "configs/examples/contract.yaml"))
defs = dg.Definitions(assets=[recording_asset(job) for job in compile_job(MANIFEST)])
