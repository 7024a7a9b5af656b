"""This file shows what a manifest comes down to: each of its jobs as a document of its own, with the place of every value."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path as File

from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.frozen import frozen
from mosaico_ingest.manifest.load import check_manifest, read_manifest, refusal, stand_alone
from mosaico_ingest.manifest.matrix import combinations
from mosaico_ingest.manifest.source import Path, Source, Value

__all__ = ["Expanded", "expand_manifest"]


@frozen
class Expanded:
    """One job, as a document that extends nothing and has no matrix."""

    source: Source
    cell: Mapping[str, str]
    """The values of the matrix that make it this job."""
    value: Value

    def remark(self, path: Path) -> str | None:
        """Return the place of a value that another file says, None where it is the manifest's own."""
        span = self.source.span(path)
        return None if span.file == self.source.file else f"{span.file}:{span.line}"


def expand_manifest(path: File) -> tuple[Expanded, ...]:
    """Return every job of a manifest; no variable of the environment is filled in.

    Raises:
        ManifestError: The manifest has mistakes; `findings` has one entry for each.
    """
    source = read_manifest(path)
    cells = combinations(source.value)
    findings: dict[Finding, None] = {}
    for cell in cells:
        findings.update(dict.fromkeys(check_manifest(source, env=None, cell=cell)[1]))
    if findings:
        raise refusal(tuple(findings), str(path))
    return tuple(Expanded(source, cell, stand_alone(source, cell)) for cell in cells)
