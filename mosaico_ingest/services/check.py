"""Checks of recordings and stored sequences against a data contract."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.contracts import Contract
from mosaico_ingest.errors import ContractError, IngestError, ManifestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.manifest import check_manifest, read_manifest, refusal
from mosaico_ingest.job.model import Job, JobSettings, Origin
from mosaico_ingest.pipeline.contract_check import check_contract, results_by_job
from mosaico_ingest.report.parts import ContractResult, ExpectationResult


class Checked(Struct, frozen=True):
    """The result of one recording or sequence."""

    name: str
    """The name of the sequence."""
    contract: ContractResult | None = None
    error: IngestError | None = None
    """The error that prevented the check."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of the error."""
        return () if self.error is None else self.error.findings

    @property
    def exit_code(self) -> int:
        """The exit code of the check."""
        if self.error is not None:
            return self.error.exit_code
        return 0 if self.contract is None or self.contract.passed else ContractError.exit_code


def check_jobs(jobs: Sequence[Job]) -> Iterator[Checked]:
    """Yield the results of each recording; an unreadable recording does not stop the others."""
    groups = results_by_job(jobs)
    for position, job in enumerate(jobs):
        yield _checked(job, groups.get(position, ()))


def _checked(job: Job, group: tuple[ExpectationResult, ...]) -> Checked:
    try:
        return Checked(job.sequence.name, check_contract(job, group))
    except IngestError as error:
        return Checked(job.sequence.name, error=error)


def check_sequence(
    store: str, sequence: str, expect: Path, *, env: Mapping[str, str] | None = os.environ
) -> Checked:
    """Return the results of the section `expect` of a file for a stored sequence.

    The file is a manifest or a part of one; other keys than `expect`, `adapters` and `extends` are not used.

    Raises:
        ManifestError: The file has mistakes, or no section `expect`.
        SinkError: The store does not exist or has no such sequence.
    """
    from mosaico_ingest.contracts.stored import check_stored  # noqa: PLC0415 - only stored sequences need the store
    from mosaico_ingest.destinations.store import Store  # noqa: PLC0415 - only stored sequences need the store

    contract = Contract.of(_contract_job(expect, env))
    if contract is None:
        raise ManifestError(
            "the file has no section expect", where=str(expect), hint="add the section expect"
        )
    return Checked(sequence, check_stored(contract, Store.open(store, create=False), sequence))


def _contract_job(path: Path, env: Mapping[str, str] | None) -> Job:
    """Return a job without recordings, for the contract and the adapters of a file."""
    source = read_manifest(path)
    if isinstance(source.value, dict):
        source = replace(source, value={"bag": {"path": "stored"}, **source.value})
    manifest, findings = check_manifest(source, env=env)
    if manifest is None:
        raise refusal(findings, str(path))
    sections: dict[str, Any] = {key: getattr(manifest, key) for key in JobSettings.model_fields}
    origin = Origin(str(path), path.parent, source.spans, source.key_spans)
    return Job.model_construct(None, **sections, paths=(), origin=origin)
