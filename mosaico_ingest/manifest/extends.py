"""This file joins a manifest with the ones it extends; every value keeps the place where it was written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from os.path import normpath, relpath
from pathlib import Path as File

from mosaico_ingest.diagnostics import Finding, Severity, Span
from mosaico_ingest.manifest.scalars import Scalar
from mosaico_ingest.manifest.source import Path, Source, Value, load_source
from mosaico_ingest.remote.path import is_url
from mosaico_ingest.textfile import read_whole

__all__ = ["KEY", "MAX_FILES", "bases_of", "extended"]

KEY = "extends"
MAX_FILES = 100
"""How many files one document may extend, each counted as often as it is named."""
_PATHS: tuple[Path, ...] = (
    ("bag", "path"),
    ("bag", "path", None),
    ("bag", "custom_msgs", None, "path"),
    ("sequence", "metadata_file"),
    ("target", "store"),
    ("target", "tls_cert"),
    ("quarantine", "path"),
    ("run", "report"),
)
"""Where a manifest has paths; None stands for every key and position."""
_ADAPTERS: tuple[Path, ...] = (("adapters", "load", None), ("adapters", "override", None))
"""Where it may have them: an adapter is named by a file, or otherwise."""


def extended(source: Source, *, folder: File) -> Source:
    """Return a document with everything of the files it extends that it does not say itself.

    Mappings are joined key by key, the document's own keys first; anything else it says stands for itself, and an
    empty value takes a key away. Paths of another file are rewritten to start in `folder`, the document's own.
    What is wrong with the other files is among the findings.
    """
    return _extended(source, folder, (), count(1))


def bases_of(source: Source, *, folder: File) -> Iterator[tuple[File, Span]]:
    """Yield the files a document names to be extended, and where it does; later ones count more."""
    named = source.at((KEY,))
    for position, name in enumerate(named if isinstance(named, list) else [named]):
        if isinstance(name, str) and name:
            place = (KEY, position) if isinstance(named, list) else (KEY,)
            yield File(normpath(folder / File(name).expanduser())), source.span(place)


def _extended(source: Source, folder: File, chain: tuple[File, ...], read: Iterator[int]) -> Source:
    if not isinstance(source.value, dict):
        return source
    for path, span in reversed(list(bases_of(source, folder=folder))):
        base = _base(path, span, chain, read)
        if isinstance(base, Finding):
            source = replace(source, findings=(*source.findings, base))
        else:
            source = _joined(source, _moved(base, relpath(path.parent, folder)))
    return source


def _base(path: File, span: Span, chain: tuple[File, ...], read: Iterator[int]) -> Source | Finding:
    """Read a file to extend, with all it extends itself; a finding at `span` where that cannot be done."""
    here = path.resolve()
    if here in chain:
        names = " → ".join(file.name for file in (*chain[chain.index(here) :], here))
        return _finding(f"files extend one another: {names}", span, "take one of them out")
    if next(read) > MAX_FILES:
        return _finding(f"{path} is one of more than {MAX_FILES} files", span, "extend fewer files")
    try:
        text = read_whole(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or str(error)).lower() if isinstance(error, OSError) else "it is not UTF-8"
        return _finding(f"{path} cannot be extended: {why}", span, "name a manifest, or a part of one")
    source = load_source(text, file=str(path))
    if not isinstance(source.value, dict) and not source.findings:
        return _finding(f"{path} cannot be extended: it holds no mapping", span, "name a part of a manifest")
    return _extended(source, path.parent, (*chain, here), read)


def _finding(message: str, span: Span, remedy: str) -> Finding:
    return Finding("missing-base", Severity.ERROR, message, span, remedy)


@dataclass(slots=True)
class _Join:
    """Joins two values, and records which paths came from the base and which the document removed."""

    taken: set[Path] = field(default_factory=set[Path])
    dropped: set[Path] = field(default_factory=set[Path])

    def value(self, own: Value, base: Value, path: Path) -> Value:
        if not (isinstance(own, dict) and isinstance(base, dict)):
            return own
        joined: dict[Scalar, Value] = {}
        for key, value in own.items():
            if value is None and key in base:
                self.dropped.add((*path, key))
            else:
                joined[key] = self.value(value, base[key], (*path, key)) if key in base else value
        for key in base:
            if key not in own and (*path, key) != (KEY,):
                self.taken.add((*path, key))
                joined[key] = base[key]
        return joined

    def places(self, own: dict[Path, Span], base: dict[Path, Span]) -> dict[Path, Span]:
        kept = {path: span for path, span in own.items() if not _below(path, self.dropped)}
        return {**kept, **{path: span for path, span in base.items() if _below(path, self.taken)}}


def _below(path: Path, roots: set[Path]) -> bool:
    return any(path[:length] in roots for length in range(1, len(path) + 1))


def _joined(own: Source, base: Source) -> Source:
    join = _Join()
    value = join.value(own.value, base.value, ())
    return Source(
        own.file,
        own.text,
        value,
        (*own.findings, *base.findings),
        join.places(own.spans, base.spans),
        join.places(own.key_spans, base.key_spans),
        {**base.others, base.file: base.text, **own.others},
    )


def _moved(source: Source, way: str) -> Source:
    """Return a document whose relative paths start elsewhere; `way` leads from there to where they started."""
    return replace(source, value=_moved_value(source.value, (), way)) if way != "." else source


def _moved_value(value: Value, path: Path, way: str) -> Value:
    if isinstance(value, dict):
        return {key: _moved_value(inner, (*path, key), way) for key, inner in value.items()}
    if isinstance(value, list):
        return [_moved_value(inner, (*path, i), way) for i, inner in enumerate(value)]
    if isinstance(value, str) and _is_path(value, path) and _is_relative(value):
        return File(normpath(File(way, value))).as_posix()
    return value


def _is_path(text: str, path: Path) -> bool:
    return _among(path, _PATHS) or (
        _among(path, _ADAPTERS) and (text.endswith((".yaml", ".yml")) or ".py:" in text)
    )


def _among(path: Path, patterns: tuple[Path, ...]) -> bool:
    return any(
        len(path) == len(pattern)
        and all(wanted in (None, part) for wanted, part in zip(pattern, path, strict=True))
        for pattern in patterns
    )


def _is_relative(text: str) -> bool:
    """Say whether a path starts at the manifest's folder; one that starts with a variable is left as it is."""
    return text != "" and not text.startswith(("/", "~", "${")) and not is_url(text)
