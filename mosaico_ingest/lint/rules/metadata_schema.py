"""The check of `metadata-schema`: metadata that violates its schema."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.model import Manifest, combined_settings
from mosaico_ingest.job.values import is_glob
from mosaico_ingest.job.yaml_source import KeyPath, Source
from mosaico_ingest.lint.check import Check, Job, Problem, manifests_of_matrix
from mosaico_ingest.metadata import (
    MetadataSchema,
    Spans,
    Violation,
    load_schema,
    read_json,
    source_spans,
    topic_section,
    violations,
)

_SEQUENCE = ("sequence", "metadata")


def check(job: Job) -> Iterator[Problem]:
    """Report violations in every job of a matrix, except where the recording or an unset variable decides."""
    findings: dict[Finding, None] = {}
    for manifest in manifests_of_matrix(job) if _has_schema(job.manifest) else ():
        findings.update(dict.fromkeys(_sequence_findings(job, manifest)))
        findings.update(dict.fromkeys(_topic_findings(job, manifest)))
    for finding in findings:
        yield Problem(finding.message, finding.span or job.source.span(()), finding.help, finding.fix)


def _has_schema(manifest: Manifest) -> bool:
    settings = (manifest.sequence, *manifest.topic_settings.values())
    return any(section.metadata_schema is not None for section in settings)


def _sequence_findings(job: Job, manifest: Manifest) -> Iterator[Finding]:
    schema = _schema(job, manifest.sequence.metadata_schema)
    if schema is None:
        return
    spans = Spans(dict(job.source.spans), dict(job.source.key_spans))
    metadata: dict[str, Any] = {}
    file = manifest.sequence.metadata_file
    if file is not None:
        source = read_json(job.resolve(file)) if job.is_expanded(file) else None
        if not isinstance(source, Source) or not isinstance(source.value, dict):
            return  # another rule reports the file
        metadata = {str(key): value for key, value in source.value.items()}
        for key in metadata.keys() - manifest.sequence.metadata.keys():
            values, keys = source_spans(source, key)
            spans = Spans({**values, **spans.values}, {**keys, **spans.keys})
    metadata |= manifest.sequence.metadata

    def is_uncertain(violation: Violation) -> bool:
        return _has_unset_variable(violation, metadata, _SEQUENCE) or _recording_decides(violation, manifest)

    yield from violations(schema, metadata, _SEQUENCE, spans, is_uncertain=is_uncertain)


def _recording_decides(violation: Violation, manifest: Manifest) -> bool:
    """Return whether `metadata_from` may remove a violation: it can add keys at the top level."""
    sources = manifest.sequence.metadata_from
    if sources is None or violation.path != _SEQUENCE:
        return False
    if violation.key is None:
        return True
    only_file_name = not (sources.records or sources.custom_data or sources.sidecar)
    names = sources.file_name.names if sources.file_name is not None else ()
    return violation.is_missing and (not only_file_name or violation.key in names)


def _topic_findings(job: Job, manifest: Manifest) -> Iterator[Finding]:
    """Yield the violations of topics that are named, and of globs that define metadata."""
    spans = Spans(job.source.spans, job.source.key_spans)
    for topic, entry in manifest.topic_settings.items():
        settings = entry if is_glob(topic) else combined_settings(manifest.topic_settings, topic)
        if is_glob(topic) and "metadata" not in entry.model_fields_set:
            continue
        schema = _schema(job, settings.metadata_schema)
        if schema is None:
            continue
        section, metadata = topic_section(manifest.topic_settings, topic), settings.metadata

        def is_uncertain(
            violation: Violation, metadata: dict[str, Any] = metadata, section: KeyPath = section
        ) -> bool:
            return _has_unset_variable(violation, metadata, section)

        yield from violations(schema, metadata, section, spans, is_uncertain=is_uncertain)


def _schema(job: Job, path: str | None) -> MetadataSchema | None:
    """Return a schema of the manifest, or None if there is none or other rules report its mistakes."""
    if path is None or not job.is_expanded(path):
        return None
    try:
        return load_schema(Path(job.resolve(path)))
    except ManifestError:
        return None


def _has_unset_variable(violation: Violation, metadata: dict[str, Any], section: KeyPath) -> bool:
    """Return whether the value of a violation contains a variable that is not replaced."""
    value: Any = metadata
    for part in violation.path[len(section) :]:
        value = value[part]
    return isinstance(value, str) and "${" in value


CHECK = Check("metadata-schema", job=check, reads_files=True)
