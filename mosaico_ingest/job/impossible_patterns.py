"""Topic patterns of a manifest that cannot match any topic name."""

from __future__ import annotations

import re
from collections.abc import Iterator

from msgspec import Struct

from mosaico_ingest.findings import Span
from mosaico_ingest.job.fields import TopicGlob, marked_fields, values_at
from mosaico_ingest.job.model import JobSettings, Manifest
from mosaico_ingest.job.yaml_source import KeyPath, Source

_MISTAKES = (
    (
        re.compile(r"\.[*+]|\\|[$^()|]"),
        "it is a regular expression",
        "write a glob, in which * matches any text",
    ),
    (re.compile(r"\s"), "it contains a space", "remove the space"),
    (re.compile(r"//"), "it contains two slashes in a row", "remove one slash"),
    (re.compile(r"(?<=.)/$"), "it ends with a slash", "remove the slash, or write /*"),
    (
        re.compile(r"\[(?!(?:!|(?!!))(?:\][^\]]*|[^\]]+)\]).*"),
        "its [ is never closed",
        "close the bracket, as in [ab], or write ? for a single character",
    ),
)


class PatternProblem(Struct, frozen=True):
    """A pattern that cannot match, the reason with its span, and a hint."""

    pattern: str
    message: str
    span: Span
    hint: str


def pattern_problems(manifest: Manifest, source: Source) -> Iterator[PatternProblem]:
    """Yield a problem for each pattern of `topics` and `expect` that cannot match any topic name."""
    for field in marked_fields(JobSettings, TopicGlob):
        if field.is_key:
            continue
        for path, pattern in values_at(manifest, field.path):
            if isinstance(pattern, str) and (pattern == "" or pattern != field.marker.default):
                yield from _problems(pattern, path, source, excludes=field.marker.excludes)


def _problems(pattern: str, path: KeyPath, source: Source, *, excludes: bool) -> Iterator[PatternProblem]:
    if excludes and pattern in {"", "!"}:
        yield PatternProblem(pattern, f"{pattern!r} excludes nothing", source.span(path), 'write "!/topic"')
        return
    for mistake, reason, hint in _MISTAKES:
        match = mistake.search(pattern)
        if match is not None:
            span = source.inner_span(path, match.start(), match.end())
            yield PatternProblem(pattern, f"{pattern!r} matches no topic, because {reason}", span, hint)
            return
