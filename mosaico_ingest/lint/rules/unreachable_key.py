"""The check of `unreachable-key`: a glob that an earlier glob hides."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import is_glob
from mosaico_ingest.job.yaml_source import Value
from mosaico_ingest.lint.check import Check, Job, Problem, covers, keyed_patterns


def check(job: Job) -> Iterator[Problem]:
    """Report each glob that an earlier glob of the same section covers."""
    globs: list[tuple[str, str, int]] = []
    for section, pattern, span in keyed_patterns(job):
        if not is_glob(pattern):
            continue
        for earlier_section, earlier, line in globs:
            if (
                earlier_section == section
                and covers(earlier, pattern)
                and _hides(job, section, earlier, pattern)
            ):
                message = f"{pattern!r} is never used, because {earlier!r} in line {line} covers it"
                yield Problem(message, span, "put it above that glob")
                break
        globs.append((section, pattern, span.line))


def _hides(job: Job, section: str, earlier: str, pattern: str) -> bool:
    """Return whether an entry defines every setting of a later one; for a section without settings, always."""
    entries = job.source.at(tuple(section.split(".")))
    if section != "expect.topics" or not isinstance(entries, dict):
        return True
    return _settings(entries[pattern]) <= _settings(entries[earlier])


def _settings(entry: Value) -> set[tuple[str, str]]:
    """Return the keys of an entry, and the expressions below `fields`."""
    if not isinstance(entry, dict):
        return set()
    fields = entry.get("fields")
    expressions = {("fields", str(name)) for name in fields} if isinstance(fields, dict) else set()
    return {(str(name), "") for name in entry if name not in {"fields", "severity"}} | expressions


CHECK = Check("unreachable-key", job=check)
