"""Loads job manifests from YAML text and environment variables, and reports all findings together."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, cast

from msgspec import Struct, field
from msgspec.structs import replace
from pydantic import ValidationError

from mosaico_ingest.containers import RECORDING_NAME
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.compose import Filled, combinations, extended, fill_in, fill_in_cell
from mosaico_ingest.job.model import Manifest, Origin
from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.job.section import Section
from mosaico_ingest.job.validation import explain
from mosaico_ingest.job.yaml_source import KeyPath, Source, Value, load_source, member, resolve_plain
from mosaico_ingest.remote import AnyPath, RemotePath, is_url, parse_url
from mosaico_ingest.textfile import read_limited


class LoadedManifest(Struct, frozen=True):
    """A valid manifest, with the span of each of its values."""

    manifest: Manifest
    source: Source
    path: Path
    cell: Mapping[str, str] = field(default_factory=dict[str, str])
    """The values of the matrix variables for this job."""

    @property
    def origin(self) -> Origin:
        """The manifest's file and folder, and the span of each key and value."""
        return Origin(str(self.path), self.path.parent, self.source.spans, self.source.key_spans)

    def where(self, *path: str | int) -> str:
        """Return `file:line:column` of the value at a key path."""
        return str(self.source.span(path))

    def for_recording(self, recording: AnyPath) -> LoadedManifest:
        """Return the manifest with another recording."""
        path = recording.url if isinstance(recording, RemotePath) else str(recording)
        bag = self.manifest.bag.replace(path=path)
        return replace(self, manifest=self.manifest.replace(bag=bag))

    def resolve(self, path: str, *key_path: str | int) -> Path:
        """Return a path of the manifest as a path relative to the current folder.

        Raises:
            ManifestError: The path is a URL; the error's location is that of `key_path`.
        """
        if is_url(path):
            message = f"{'.'.join(map(str, key_path))} is a URL, but only recordings and stores can be URLs"
            raise self._wrong_url(message, "name a local file", key_path)
        return self.path.parent / Path(path).expanduser()

    def resolve_or_url(self, path: str, *key_path: str | int) -> AnyPath:
        """Return a path of the manifest as a path relative to the current folder, or the remote path of a URL.

        Raises:
            ManifestError: The URL is invalid; the error's location is that of `key_path`.
        """
        if not is_url(path):
            return self.resolve(path, *key_path)
        try:
            return parse_url(path)
        except IngestError as error:
            raise self._wrong_url(f"{error.where}: {error.what}", error.hint, key_path) from error

    def _wrong_url(self, message: str, hint: str | None, key_path: KeyPath) -> ManifestError:
        finding = Finding("wrong-url", Severity.ERROR, message, self.source.span(key_path), hint)
        return ManifestError(message, where=str(finding.span), hint=hint, findings=(finding,))


def load_manifest(path: Path | str, *, env: Mapping[str, str] | None = os.environ) -> LoadedManifest:
    """Load a job manifest, or the first job of its matrix; see `load_manifests`."""
    return load_manifests(path, env=env)[0]


def load_manifests(
    path: Path | str, *, env: Mapping[str, str] | None = os.environ
) -> tuple[LoadedManifest, ...]:
    """Load every job of a manifest, merged with the files it extends; `env=None` ignores the environment.

    Raises:
        ManifestError: The file cannot become a job; `findings` has one entry for each mistake.
    """
    file = Path(path)
    source = read_manifest(file)
    jobs: list[LoadedManifest] = []
    findings: dict[Finding, None] = {}
    for cell in combinations(source.value):
        manifest, mistakes = check_manifest(source, env=env, cell=cell)
        findings.update(dict.fromkeys(mistakes))
        if manifest is not None:
            jobs.append(LoadedManifest(manifest, source, file, cell))
    if findings or not jobs:
        raise refusal(tuple(findings), str(path))
    return tuple(jobs)


def read_manifest(path: Path) -> Source:
    """Read a manifest merged with the files it extends; `findings` has the mistakes of all of them.

    Raises:
        ManifestError: The file cannot be read.
    """
    return extended(load_source(read_text(path), file=str(path)), folder=path.parent)


def check_manifest(
    source: Source, *, env: Mapping[str, str] | None, cell: Mapping[str, str] | None = None
) -> tuple[Manifest | None, tuple[Finding, ...]]:
    """Return the model (None if the manifest has mistakes) and the findings in the order of the text.

    `cell` contains the values of one combination of the matrix and defaults to the first combination.
    """
    if not isinstance(source.value, dict):
        return None, source.findings or (_not_a_job(source),)
    filled = fill_in(source, env, cell)
    findings = [*source.findings, *filled.findings]
    filled.value = _without_other_keys(filled.value, (), source, findings)
    manifest, mistakes = _validate(source, filled)
    reported = {finding.span for finding in findings}
    if any(finding.rule == "missing-base" for finding in findings):
        mistakes = [finding for finding in mistakes if finding.rule != "missing-key"]
    findings += [finding for finding in mistakes if finding.span not in reported]
    ordered = tuple(sorted(findings, key=lambda finding: finding.span or Span("", 0, 0, 0, 0)))
    return (None if ordered else manifest), ordered


def stand_alone(source: Source, cell: Mapping[str, str]) -> Value:
    """Return one job of a manifest as a document without `extends` and `matrix`, with the matrix variables replaced.

    Environment variables stay as written, together with the defaults that they may need.
    """
    filled = fill_in_cell(source, cell)
    _validate(source, filled)  # converts the texts that have to be numbers
    if not isinstance(filled.value, dict):
        return filled.value
    defaults = filled.value.get("defaults")
    job = {key: value for key, value in filled.value.items() if key not in {"extends", "defaults", "matrix"}}
    if isinstance(defaults, dict) and (unfilled := {k: v for k, v in defaults.items() if k not in cell}):
        return {"defaults": unfilled, **job}
    return job


_WITHOUT_MANIFEST = "run `ingest bag RECORDING --name NAME`, or draft a manifest with `ingest init RECORDING`"


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        ManifestError: The file does not exist, is not readable, or is not UTF-8.
    """
    if path.is_dir() or RECORDING_NAME.search(path.name):
        kind = "a folder" if path.is_dir() else "a recording"
        finding = Finding(
            "unreadable-file", Severity.ERROR, f"{path} is {kind}, not a manifest", help=_WITHOUT_MANIFEST
        )
        raise refusal((finding,), str(path))
    try:
        return read_limited(path).decode()
    except UnicodeDecodeError as err:
        message = f"not UTF-8 text: byte {err.start} is 0x{err.object[err.start]:02x}"
        finding = Finding(
            "not-utf8", Severity.ERROR, message, Span(str(path), 1, 1, 1, 1), "save it as UTF-8"
        )
        raise refusal((finding,), str(path)) from err
    except OSError as err:
        message = f"cannot be read: {(err.strerror or str(err)).lower()}"
        finding = Finding("unreadable-file", Severity.ERROR, message, Span(str(path), 1, 1, 1, 1))
        raise refusal((finding,), str(path)) from err


def refusal(findings: tuple[Finding, ...], where: str) -> ManifestError:
    """Return the error for a manifest with these findings, or for a manifest that is incomplete without its variables."""
    if not findings:
        return ManifestError(
            "the manifest is incomplete without its environment variables",
            where=where,
            hint="set them in the environment",
        )
    first = findings[0]
    if len(findings) == 1:
        return ManifestError(
            first.message, where=str(first.span or where), hint=first.help, findings=findings
        )
    return ManifestError(
        f"{len(findings)} mistakes; the first: {first.message}", where=where, findings=findings
    )


def _not_a_job(source: Source) -> Finding:
    span = source.span(())
    if source.value is None:
        return Finding(
            "empty-manifest", Severity.ERROR, "the manifest is empty", span, "start with bag: {path: …}"
        )
    return Finding("not-a-mapping", Severity.ERROR, "a job is a mapping", span, "start with bag: {path: …}")


def _without_other_keys(value: Value, path: KeyPath, source: Source, findings: list[Finding]) -> Value:
    """Report keys that are not text, and return the value without them."""
    if isinstance(value, list):
        return [_without_other_keys(item, (*path, i), source, findings) for i, item in enumerate(value)]
    if not isinstance(value, dict):
        return value
    for key in value:
        if not isinstance(key, str):
            span = source.key_span((*path, key))
            message = f"the key {json.dumps(key)} is not text"
            findings.append(Finding("yaml-key", Severity.ERROR, message, span, "quote it"))
    return {
        key: _without_other_keys(inner, (*path, key), source, findings)
        for key, inner in value.items()
        if isinstance(key, str)
    }


def _validate(source: Source, filled: Filled) -> tuple[Manifest | None, list[Finding]]:
    """Validate a document: convert replaced texts to numbers if required, and ignore values with unset variables."""
    manifest, mistakes = _attempt(source, filled.value)
    retry = [key_path for key_path, _ in mistakes if key_path in filled.changed]
    if retry:
        for key_path in dict.fromkeys(retry):
            _reread(filled, key_path)
        manifest, mistakes = _attempt(source, filled.value)
    return manifest, [finding for key_path, finding in mistakes if key_path not in filled.unknown]


def _attempt(source: Source, value: Value) -> tuple[Manifest | None, list[tuple[KeyPath, Finding]]]:
    try:
        # In JSON mode, `strict` refuses text for numbers and accepts lists for tuples and words for enumerations.
        manifest = Manifest.model_validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        return None, explain(error, source=source, schema=_schema())
    mistakes = [(path, _empty_value(source, path)) for path in _nulls(manifest)]
    return None if mistakes else manifest, mistakes


def _nulls(section: object, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Yield the key path of each null that a manifest contains; free values, such as metadata, may contain null."""
    if isinstance(section, Section):
        for name in section.model_fields_set:
            value = getattr(section, name)
            if value is None:
                yield (*path, name)
            else:
                yield from _nulls(value, (*path, name))
    elif isinstance(section, dict):
        for key, value in cast("dict[str, object]", section).items():
            yield from _nulls(value, (*path, key))
    elif isinstance(section, tuple):
        for position, value in enumerate(cast("tuple[object, ...]", section)):
            yield from _nulls(value, (*path, position))


def _empty_value(source: Source, path: KeyPath) -> Finding:
    message = f"{'.'.join(map(str, path))} is empty"
    hint = "give it a value, or remove the key"
    return Finding("empty-value", Severity.ERROR, message, source.key_span(path), hint)


def _reread(filled: Filled, key_path: KeyPath) -> None:
    """Convert a replaced text to the value of an unquoted YAML scalar, or remove it if its variable is not set."""
    parent = filled.value
    for part in key_path[:-1]:
        parent = member(parent, part)
    if isinstance(parent, dict):
        value = parent[key_path[-1]]
        if key_path in filled.unknown:
            del parent[key_path[-1]]
        elif isinstance(value, str):
            parent[key_path[-1]] = resolve_plain(value)[0]


@cache
def _schema() -> dict[str, Any]:
    return job_schema()
