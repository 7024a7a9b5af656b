"""This file finds the same kind of thing wherever a job may say it: topic names, metadata, paths."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.diagnostics import Span
from mosaico_ingest.lint.job import Job
from mosaico_ingest.manifest.source import Path, Value
from mosaico_ingest.remote.path import without_options

__all__ = [
    "all_paths",
    "keyed_patterns",
    "keys_below",
    "metadata_places",
    "recording_paths",
    "topic_patterns",
    "values_below",
]

_KEYED = (("topic_settings",), ("adapters", "override"), ("on_error", "topic"))
_DEFAULT = ("on_error", "topic", "default")


def topic_patterns(job: Job) -> Iterator[tuple[str, str, Span]]:
    """Yield each name or glob of topics: the section it is in, the text, its place."""
    for i, pattern in enumerate(job.manifest.topics):
        yield "topics", pattern, job.span("topics", i)
    yield from keyed_patterns(job)


def keyed_patterns(job: Job) -> Iterator[tuple[str, str, Span]]:
    """Yield each name or glob of topics that is a key, in the order that decides."""
    for section in _KEYED:
        keyed = job.source.at(section)
        for key in keyed if isinstance(keyed, dict) else ():
            if isinstance(key, str) and (*section, key) != _DEFAULT:
                yield ".".join(section), key, job.key_span(*section, key)


def metadata_places(job: Job) -> Iterator[Path]:
    """Yield where metadata is: the sequence's, and each topic setting's."""
    yield ("sequence", "metadata")
    for topic in job.manifest.topic_settings:
        yield ("topic_settings", topic, "metadata")


def recording_paths(job: Job) -> Iterator[tuple[Path, str]]:
    """Yield each path of `bag.path` that is known, without a URL's options, with its place."""
    path = job.manifest.bag.path
    if isinstance(path, str):
        if job.known(path):
            yield ("bag", "path"), without_options(path)
        return
    for i, part in enumerate(path):
        if job.known(part):
            yield ("bag", "path", i), without_options(part)


def all_paths(job: Job) -> Iterator[tuple[Path, str]]:
    """Yield every path a job names, with its place."""
    manifest = job.manifest
    yield from recording_paths(job)
    for i, custom in enumerate(manifest.bag.custom_msgs):
        yield ("bag", "custom_msgs", i, "path"), custom.path
    single: dict[Path, str | None] = {
        ("sequence", "metadata_file"): manifest.sequence.metadata_file,
        ("target", "store"): manifest.target.store,
        ("target", "tls_cert"): manifest.target.tls_cert,
        ("run", "report"): manifest.run.report,
    }
    for place, path in single.items():
        if path is not None and job.known(path):
            yield place, path


def values_below(value: Value, path: Path) -> Iterator[Path]:
    """Yield the path of every single value inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from values_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from values_below(inner, (*path, i))
    else:
        yield path


def keys_below(value: Value, path: Path) -> Iterator[Path]:
    """Yield the path of every key inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key)
            yield from keys_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from keys_below(inner, (*path, i))
