"""The metadata that a recording fills on its own: `sequence.metadata_from`, evaluated on an opened recording."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity, Span, join_names, nearest
from mosaico_ingest.job.model import Job, Origin
from mosaico_ingest.job.values import FileNamePattern
from mosaico_ingest.job.yaml_source import KeyPath, Source
from mosaico_ingest.metadata.validation import load_schema, read_json, with_required_types
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.recording import Recording

_SECTION = ("sequence", "metadata")
_REFUSED = re.compile(r"[^A-Za-z0-9 _-]+|-(?=-)")
"""Characters that the platform rejects in metadata keys."""


class _Addition(Struct, frozen=True):
    """The metadata of one source, or the reason why the source has none."""

    source: str
    """The source in words, such as `the file name`."""
    span: Span | None
    """The span of the source in the manifest."""
    values: Mapping[str, Any] = {}
    problem: str | None = None
    hint: str | None = None
    file: Source | None = None
    """The side-car file that contains the values."""


class _Merged(Struct):
    values: dict[str, Any] = field(default_factory=dict[str, Any])
    owners: dict[str, _Addition] = field(default_factory=dict[str, _Addition])
    findings: list[Finding] = field(default_factory=list[Finding])


def fill_in_metadata(job: Job, recording: Recording) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job with the final metadata of its sequence, and findings about sources without a match.

    Raises:
        ManifestError: A side-car file is not a JSON object, or the platform refuses the metadata.
        BagError: The recording cannot be read.
    """
    if job.sequence.metadata_from is None:
        return job, ()
    merged = _Merged()
    for addition in _additions(job, recording):
        _merge(merged, addition)
    spans, key_spans = dict[KeyPath, Span](), dict[KeyPath, Span]()
    for key, owner in merged.owners.items():
        if owner.file is not None:
            values, keys = source_spans(owner.file, key)
            spans.update(values)
            key_spans.update(keys)
        elif owner.span is not None:
            path = (*_SECTION, key)
            spans[path] = key_spans[path] = owner.span
    metadata = {**merged.values, **job.sequence.metadata}
    completed = job.replace(
        sequence=job.sequence.replace(metadata=metadata),
        origin=with_spans(job.origin, spans, key_spans),
    )
    return completed.check(), tuple(merged.findings)


def source_spans(source: Source, key: str) -> tuple[dict[KeyPath, Span], dict[KeyPath, Span]]:
    """Return the spans of the values and keys below a top-level key of a JSON file, as key paths of the metadata."""

    def below(spans: Mapping[KeyPath, Span]) -> dict[KeyPath, Span]:
        return {(*_SECTION, *path): span for path, span in spans.items() if path[:1] == (key,)}

    return below(source.spans), below(source.key_spans)


def with_spans(origin: Origin, spans: Mapping[KeyPath, Span], key_spans: Mapping[KeyPath, Span]) -> Origin:
    """Return an origin with further spans; those of the manifest take precedence."""
    return replace(origin, spans={**spans, **origin.spans}, key_spans={**key_spans, **origin.key_spans})


def _merge(merged: _Merged, addition: _Addition) -> None:
    """Add the values of a source, which take precedence over those of earlier sources."""
    if addition.problem is not None:
        merged.findings.append(
            Finding("metadata-source", Severity.WARNING, addition.problem, addition.span, addition.hint)
        )
    for key, value in addition.values.items():
        if key in merged.values and merged.values[key] != value:
            merged.findings.append(_conflict(key, merged, addition))
        merged.values[key] = value
        merged.owners[key] = addition


def _conflict(key: str, merged: _Merged, addition: _Addition) -> Finding:
    before, after = merged.values[key], addition.values[key]
    return Finding(
        "metadata-conflict",
        Severity.WARNING,
        f"{key} is {before!r} in {merged.owners[key].source} and {after!r} in {addition.source};"
        f" {addition.source} takes precedence",
        addition.span,
        "correct the wrong source, or set the key in sequence.metadata",
    )


def _additions(job: Job, recording: Recording) -> Iterator[_Addition]:
    """Yield the metadata of each source, in ascending order of precedence."""
    sources = job.sequence.metadata_from
    if sources is None:
        return
    path = job.main_path
    if sources.records:
        yield from _record_additions(job, sources.records, recording)
    if sources.custom_data:
        yield _custom_data(job, recording)
    if sources.file_name is not None:
        yield _file_name(job, sources.file_name, path)
    sidecar = job.sidecar
    if sidecar is not None:
        yield _sidecar(job, sidecar)


def _span(job: Job, *path: str | int) -> Span | None:
    return job.value_span("sequence", "metadata_from", *path) or job.span("sequence", "metadata_from", *path)


def _record_additions(job: Job, patterns: Sequence[str], recording: Recording) -> Iterator[_Addition]:
    records = recording.metadata_records()
    for position, pattern in enumerate(patterns):
        span = _span(job, "records", position)
        names = [name for name in records if fnmatchcase(name, pattern)]
        if not names:
            problem = f"no metadata record matches {pattern!r}"
            close = nearest(pattern, records)
            hint = (
                f"the recording has {join_names(records)}"
                if records
                else "the recording has no metadata records"
            )
            hint = f"did you mean {close!r}? {hint}" if close else hint
            yield _Addition("the metadata records", span, problem=problem, hint=hint)
        for name in names:
            yield _Addition(f"the metadata record {name!r}", span, _values(job, records[name]))


def _custom_data(job: Job, recording: Recording) -> _Addition:
    span, data = _span(job, "custom_data"), recording.custom_data()
    if data:
        return _Addition("custom_data", span, _values(job, data))
    return _Addition(
        "custom_data",
        span,
        problem="the recording has no custom_data",
        hint="record with `ros2 bag record --custom-data KEY=VALUE`, or remove the key",
    )


def _values(job: Job, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the texts of a source with the types that the metadata schema requires.

    `_` replaces characters that the platform rejects in keys, and empty keys are dropped.
    """
    texts_by_key = {name: text for key, text in texts.items() if (name := _REFUSED.sub("_", key))}
    path = job.sequence.metadata_schema
    return (
        with_required_types(load_schema(Path(path)), texts_by_key) if path is not None else dict(texts_by_key)
    )


def _file_name(job: Job, pattern: FileNamePattern, path: AnyPath) -> _Addition:
    names = [path.name]
    for _ in range(1, pattern.depth):
        path = path.parent
        names.insert(0, path.name)
    name, span = "/".join(names), _span(job, "file_name")
    values = pattern.match(name)
    if values is not None:
        return _Addition("the file name", span, values)
    return _Addition(
        "the file name",
        span,
        problem=f"the file name {name!r} does not match {pattern.text!r}",
        hint="rename the recording, or correct the pattern",
    )


def _sidecar(job: Job, file: AnyPath) -> _Addition:
    """Return the content of the side-car file; a file that is not a JSON object ends the plan."""
    span = _span(job, "sidecar")
    if not file.is_file():
        problem = f"the side-car file {file} does not exist"
        return _Addition("the side-car file", span, problem=problem, hint="add the file, or remove the key")
    source = read_json(file)
    if isinstance(source, Finding):
        raise _refusal(replace(source, rule="invalid-sidecar"))
    if not isinstance(source.value, dict):
        message = f"{file} has no JSON object"
        raise _refusal(
            Finding("invalid-sidecar", Severity.ERROR, message, source.span(()), 'write {"key": "value"}')
        )
    values = {str(key): value for key, value in source.value.items()}
    return _Addition("the side-car file", span, values, file=source)


def _refusal(finding: Finding) -> ManifestError:
    return ManifestError(finding.message, where=str(finding.span), hint=finding.help, findings=(finding,))
