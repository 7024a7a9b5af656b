"""The documents that lint checks, and how lint recognizes them in files, folders and Markdown pages."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from difflib import get_close_matches
from enum import Enum
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.containers import SUFFIXES
from mosaico_ingest.job.model import Manifest
from mosaico_ingest.job.values import LOCK_SUFFIX

_YAML_SUFFIXES = (".yaml", ".yml", ".json")
_MARKDOWN_SUFFIXES = (".md", ".markdown")
_SUFFIXES = (*_YAML_SUFFIXES, *_MARKDOWN_SUFFIXES, ".msg")

_FENCE = re.compile(r"^ *(?P<fence>```+|~~~+) *(?P<language>\w*)[^\n]*$")
_SKIP_BLOCK = "# ingest: skip"
"""A comment that excludes a block of a Markdown page from lint."""

_KEY_LINE = re.compile(
    r"^(?P<indent> *)(?P<quote>[\"']?)(?P<key>[A-Za-z_][\w-]*)(?P=quote)[ \t]*:(?=\s|$)", re.MULTILINE
)
_FLOW_KEY = re.compile(r"[{,\s](?P<quote>[\"']?)(?P<key>[A-Za-z_][\w-]*)(?P=quote)\s*:(?=\s|$|[\[{\"'])")
_RECORDING = re.compile(rf"({'|'.join(map(re.escape, SUFFIXES))})\b", re.IGNORECASE)
_VERSION = re.compile(r"[\"']?\bversion[\"']?[ \t]*:[ \t]*[\"']?\d+[\"']?[ \t]*(?=[\n,}#]|$)")

_ADAPTER_KEYS = frozenset({"adapter", "ros_type", "variants"})
_AMBIGUOUS_KEYS = frozenset({"version", "extends", "defaults", "matrix", "run"})
"""Manifest keys that are also common in the files of other tools."""
_JOB_KEYS = frozenset(Manifest.model_fields) - _AMBIGUOUS_KEYS
_SECTION_KEYS = _JOB_KEYS - {"topics", "target"}
"""Manifest keys of which two identify a manifest without `version`."""
_MAX_CHARACTERS = 1_000_000
"""Number of characters at the start of a file in which its keys are searched."""
_SIMILARITY = 0.75
"""Minimum ratio of `difflib` at which a key counts as a misspelled manifest key."""


class Kind(str, Enum):
    """The kind of a document."""

    JOB = "job"
    ADAPTER = "adapter"
    MESSAGE = "message"


class Document(Struct, frozen=True):
    """A text to check."""

    file: str
    """The name to show in findings."""
    text: str
    kind: Kind
    folder: Path
    """The folder that relative paths start in."""
    path: Path | None = None
    """The file that contains exactly this text, or None."""
    example: bool = False
    """Whether the text is a block of a Markdown page. Files that an example mentions need not exist."""


def files_below(folder: Path, excludes: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield the files below a folder whose suffix lint knows, except hidden files, hidden folders and excluded files."""
    for inside, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(inside, name)
            if path.suffix.lower() in _SUFFIXES and not name.startswith(".") and not excludes(path):
                yield path


def documents_in(text: str, *, file: str, path: Path | None, folder: Path, named: bool) -> Iterator[Document]:
    """Yield the documents of a file: the file itself, or the manifests and adapters in the blocks of a Markdown page.

    If the file is `named` on the command line, it is a job unless it looks like another kind of document.
    """
    suffix = Path(file).suffix.lower()
    if file.endswith(LOCK_SUFFIX):
        return  # a lock file has keys of a manifest; lint checks it with its manifest
    if suffix in _MARKDOWN_SUFFIXES:
        for block in _yaml_blocks(text):
            keys = set(_top_level_keys(block))
            kind = Kind.JOB if keys & {"bag", "extends"} else Kind.ADAPTER if "adapter" in keys else None
            if kind is not None and _SKIP_BLOCK not in block:
                yield Document(file, block, kind, folder, example=True)
        return
    kind = kind_of(text, suffix=suffix) or (Kind.JOB if named else None)
    if kind is not None:
        yield Document(file, text, kind, folder, path)


def kind_of(text: str, *, suffix: str = ".yaml") -> Kind | None:
    """Return the kind of a file's text, or None if it is not a manifest, an adapter or a message definition.

    A manifest is recognized by `bag` or `extends`, by an integer `version` together with a key that is, or nearly is, a
    manifest key, or by two sections. It need not be valid YAML.
    """
    if suffix == ".msg":
        return Kind.MESSAGE
    text = text[:_MAX_CHARACTERS].removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    keys = set(_top_level_keys(text))
    if keys & {"bag", "extends"}:
        return Kind.JOB
    if keys & _ADAPTER_KEYS or {"ontology", "fields"} <= keys:
        return Kind.ADAPTER
    if "version" in keys and _VERSION.search(text):
        if _similar(keys, _ADAPTER_KEYS):
            return Kind.ADAPTER
        if _similar(keys, _JOB_KEYS):
            return Kind.JOB
    misspelled_bag = "bag" in _similar(keys, {"bag"}) and _RECORDING.search(text) is not None
    return Kind.JOB if misspelled_bag or len(_similar(keys, _SECTION_KEYS)) > 1 else None


def looks_like_ours(content: bytes, suffix: str) -> bool:
    """Return whether bytes that are not UTF-8 are a document in another encoding."""
    return kind_of(content.replace(b"\0", b"").decode("latin-1"), suffix=suffix) is not None


def _top_level_keys(text: str) -> Iterator[str]:
    """Yield the keys of the outermost mapping of a YAML or JSON text, found without parsing, so that typos do not matter."""
    content = (line.strip() for line in text.split("\n"))
    start = next((line for line in content if line and line[0] not in "#%" and line != "---"), "")
    if start.startswith(("- ", "[")):
        return  # The document is a list.
    if start.startswith("{"):
        yield from (match["key"] for match in _FLOW_KEY.finditer(_outermost(text[text.index("{") :])))
        return
    matches = list(_KEY_LINE.finditer(text))
    indent = min((len(match["indent"]) for match in matches), default=0)
    yield from (match["key"] for match in matches if len(match["indent"]) == indent)


def _outermost(text: str) -> str:
    """Return a text that starts with `{` without the content of inner brackets."""
    depth, pieces = 0, list[str]()
    for piece in re.split(r"([\[\]{}])", text):
        depth -= piece in {"]", "}"}
        if depth <= 1:
            pieces.append(piece)
        depth += piece in {"[", "{"}
    return "".join(pieces)


def _similar(keys: Iterable[str], known: Iterable[str]) -> set[str]:
    """Return the known keys that one of `keys` equals or nearly equals."""
    names = sorted(known)
    plain = [key.lower().replace("-", "_") for key in keys]
    swapped = {name for name in names if any(sorted(key) == sorted(name) for key in plain)}
    near = {match for key in plain for match in get_close_matches(key, names, n=1, cutoff=_SIMILARITY)}
    return swapped | near


def _yaml_blocks(text: str) -> Iterator[str]:
    """Yield the YAML blocks of a Markdown text, each padded with empty lines so that line numbers stay the same."""
    fence, language, block = "", "", list[str]()
    for number, line in enumerate(text.splitlines()):
        opening = _FENCE.match(line)
        if not fence and opening is not None:
            fence, language = opening["fence"], opening["language"].lower()
            block = [""] * (number + 1)
        elif fence and line.strip() == fence:
            if language in {"yaml", "yml"}:
                yield "\n".join(block) + "\n"
            fence = ""
        else:
            block.append(line)
