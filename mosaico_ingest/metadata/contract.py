"""The metadata contracts of a job: `sequence.metadata_schema` and `topic_settings.*.metadata_schema`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from mosaico_ingest.errors import ContractError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.model import Job, TopicSettings
from mosaico_ingest.job.patterns import first_match
from mosaico_ingest.job.yaml_source import KeyPath
from mosaico_ingest.metadata.schema import load_schema
from mosaico_ingest.metadata.validation import Spans, violations
from mosaico_ingest.report.units import counted


def check_metadata_contracts(job: Job, topics: Iterable[str]) -> None:
    """Validate the metadata of a job's sequence and of these topics against their schemas.

    Raises:
        ContractError: The metadata violates a schema; `findings` has every violation.
        ManifestError: A schema is invalid.
    """
    spans = Spans(job.origin.spans, job.origin.key_spans)
    findings: list[Finding] = []
    if job.sequence.metadata_schema is not None:
        schema = load_schema(Path(job.sequence.metadata_schema))
        findings += violations(schema, job.sequence.metadata, ("sequence", "metadata"), spans)
    for topic in topics:
        settings = job.settings_of(topic)
        if settings.metadata_schema is not None:
            schema = load_schema(Path(settings.metadata_schema))
            findings += violations(schema, settings.metadata, topic_section(job.topic_settings, topic), spans)
    unique = tuple(dict.fromkeys(findings))
    if unique:
        first = unique[0]
        more = f" (and {counted(len(unique) - 1, 'more violation')})" if len(unique) > 1 else ""
        where = str(first.span) if first.span else job.origin.file
        raise ContractError(f"{first.message}{more}", where=where, hint=first.help, findings=unique)


def topic_section(settings: Mapping[str, TopicSettings], topic: str) -> KeyPath:
    """Return the key path of the metadata that applies to a topic, which exists only if a setting defines it."""

    def defining(key: str) -> str | None:
        return first_match((glob for glob, entry in settings.items() if key in entry.model_fields_set), topic)

    return ("topic_settings", defining("metadata") or defining("metadata_schema") or topic, "metadata")
