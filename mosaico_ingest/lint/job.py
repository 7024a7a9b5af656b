"""A job manifest as the rules see it: its model, key paths, topic names, paths and adapter references."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Iterator, Mapping
from copy import deepcopy
from fnmatch import fnmatchcase
from functools import reduce
from importlib.machinery import PathFinder
from pathlib import Path

from msgspec import Struct
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mosaico_ingest.findings import Finding, Span
from mosaico_ingest.job.compose import fill_in
from mosaico_ingest.job.manifest import check_manifest
from mosaico_ingest.job.sections import Manifest
from mosaico_ingest.job.validation import place_of
from mosaico_ingest.job.yaml_source import KeyPath, Source, Value, load_source, member
from mosaico_ingest.remote import without_options
from mosaico_ingest.textfile import read_whole

__all__ = [
    "Job",
    "PythonReference",
    "adapter_references",
    "all_paths",
    "bare",
    "covers",
    "find_module",
    "is_glob",
    "is_mapping_file",
    "keyed_patterns",
    "keys_below",
    "loaded_names",
    "metadata_places",
    "python_reference",
    "read_classes",
    "read_job",
    "recording_paths",
    "topic_patterns",
    "values_below",
]


def is_glob(pattern: str) -> bool:
    """Say whether a pattern can match more than one name."""
    return any(character in pattern for character in "*?[")


def bare(pattern: str) -> str:
    """Return a pattern without the `!` that makes it an exclusion."""
    return pattern.removeprefix("!")


def covers(general: str, special: str) -> bool:
    """Say whether surely every name that `special` matches is matched by `general` as well."""
    if general in {"*", special}:
        return True
    if "[" in special:
        return False
    # What stands for a wildcard of `special` matches nothing in `general` but a wildcard.
    probes = (special.replace("*", filling).replace("?", "\x00") for filling in ("", "\x00", "/\x00/\x00"))
    return all(fnmatchcase(probe, general) for probe in probes)


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


def metadata_places(job: Job) -> Iterator[KeyPath]:
    """Yield where metadata is: the sequence's, and each topic setting's."""
    yield ("sequence", "metadata")
    for topic in job.manifest.topic_settings:
        yield ("topic_settings", topic, "metadata")


def recording_paths(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield each path of `bag.path` that is known, without a URL's options, with its place."""
    path = job.manifest.bag.path
    if isinstance(path, str):
        if job.known(path):
            yield ("bag", "path"), without_options(path)
        return
    for i, part in enumerate(path):
        if job.known(part):
            yield ("bag", "path", i), without_options(part)


def all_paths(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield every path a job names, with its place."""
    manifest = job.manifest
    yield from recording_paths(job)
    for i, custom in enumerate(manifest.bag.custom_msgs):
        yield ("bag", "custom_msgs", i, "path"), custom.path
    single: dict[KeyPath, str | None] = {
        ("sequence", "metadata_file"): manifest.sequence.metadata_file,
        ("target", "store"): manifest.target.store,
        ("target", "tls_cert"): manifest.target.tls_cert,
        ("run", "report"): manifest.run.report,
    }
    for place, path in single.items():
        if path is not None and job.known(path):
            yield place, path


def values_below(value: Value, path: KeyPath) -> Iterator[KeyPath]:
    """Yield the path of every single value inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from values_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from values_below(inner, (*path, i))
    else:
        yield path


def keys_below(value: Value, path: KeyPath) -> Iterator[KeyPath]:
    """Yield the path of every key inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key)
            yield from keys_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from keys_below(inner, (*path, i))


class PythonReference(Struct, frozen=True):
    """`module:Class` or `file.py:Class`."""

    module: str
    name: str

    @property
    def is_file(self) -> bool:
        """Whether the module is given as a file."""
        return self.module.endswith(".py")


def adapter_references(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield every adapter a job names, with its place."""
    adapters = job.manifest.adapters
    for i, reference in enumerate(adapters.load):
        yield ("adapters", "load", i), reference
    for topic, reference in adapters.override.items():
        yield ("adapters", "override", topic), reference


def loaded_names(job: Job) -> set[str] | None:
    """Return what the adapters of `adapters.load` are called; None if one of them cannot be read."""
    names: set[str] = set()
    for reference in job.manifest.adapters.load:
        python = python_reference(reference)
        name = python.name.rpartition(".")[2] if python is not None else _adapter_name(job.resolve(reference))
        if name is None:
            return None
        names.add(name)
    return names


def _adapter_name(file: Path) -> str | None:
    try:
        name = load_source(read_whole(file).decode(), file=str(file)).at(("adapter",))
    except (OSError, UnicodeDecodeError):
        return None
    return name if isinstance(name, str) else None


def is_mapping_file(reference: str) -> bool:
    """Say whether a reference is the path of an adapter file."""
    return reference.endswith((".yaml", ".yml"))


def python_reference(reference: str) -> PythonReference | None:
    """Return the module and the class a reference names; None for other references."""
    module, colon, name = reference.rpartition(":")
    return PythonReference(module, name) if colon and module and name else None


def find_module(name: str, folder: Path) -> Path | None:
    """Return the source file of a module, looked for where Python does and then in `folder`; None if there is none."""
    places: list[str] | None = [*sys.path, str(folder)]
    origin: str | None = None
    for i in range(name.count(".") + 1):
        part = ".".join(name.split(".")[: i + 1])
        spec = PathFinder.find_spec(part, places)
        if spec is None:
            return None
        origin, places = spec.origin, list(spec.submodule_search_locations or ())
    return Path(origin) if origin is not None and origin.endswith(".py") else None


def read_classes(file: Path) -> dict[str, bool]:
    """Return the names a Python file defines at its top, and whether each can be an adapter.

    A class can if it has a base class or a `from_dict`; of anything else that is bound there nothing is known.

    Raises:
        SyntaxError: It is no Python.
        OSError: It cannot be read.
    """
    names: dict[str, bool] = {}
    for node in ast.parse(read_whole(file), str(file)).body:
        if isinstance(node, ast.ClassDef):
            methods = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
            names[node.name] = bool(node.bases) or "from_dict" in methods or "bind" in methods
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            names[node.name] = False
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update({(alias.asname or alias.name).partition(".")[0]: True for alias in node.names})
        elif isinstance(node, ast.Assign):
            names.update({target.id: True for target in node.targets if isinstance(target, ast.Name)})
    return names


_MISSING = "missing"
"""Stands for a text that must be there and is not, so that the rest can be judged."""


class Job(Struct, frozen=True):
    """A manifest; what the model refuses is left out of it, and reported by itself."""

    manifest: Manifest
    source: Source
    folder: Path
    """Where its relative paths start."""
    file: Path | None = None
    """The file on disk, if there is one."""

    def span(self, *place: str | int) -> Span:
        """Return the place of a value."""
        return self.source.span(place)

    def key_span(self, *place: str | int) -> Span:
        """Return the place of a key."""
        return self.source.key_span(place)

    def given(self, *place: str | int) -> bool:
        """Say whether the manifest says something there."""
        return place in self.source.spans

    def known(self, text: str | None) -> bool:
        """Say whether a text is there and holds no variable that could not be filled in."""
        return text is not None and "${" not in text and text != _MISSING

    def resolve(self, path: str) -> Path:
        """Return a path as seen from here."""
        return self.folder / Path(path).expanduser()


def read_job(
    source: Source, *, folder: Path, env: Mapping[str, str] | None, file: Path | None = None
) -> tuple[Job | None, tuple[Finding, ...]]:
    """Return the job, as much as there is of it, and what is wrong with its text and its shape."""
    manifest, findings = check_manifest(source, env=env)
    if manifest is None and isinstance(source.value, dict):
        manifest = _salvage(fill_in(source, env).value)
    return (None if manifest is None else Job(manifest, source, folder, file)), findings


def _salvage(value: Value) -> Manifest | None:
    """Take out what the model refuses until the rest holds together."""
    value = deepcopy(value)
    for _ in range(50):
        manifest, refused = _validate(value)
        if manifest is not None:
            return manifest
        for details in refused:
            _take_out(value, details["loc"], missing=details["type"] == "missing")
    return None


def _validate(value: Value) -> tuple[Manifest | None, list[ErrorDetails]]:
    try:
        return Manifest.model_validate_json(json.dumps(value), strict=True), []
    except ValidationError as error:
        return None, error.errors(include_url=False, include_context=False)


def _take_out(value: Value, location: KeyPath, *, missing: bool) -> None:
    """Remove the value at an error's location, or put a stand-in where one is missing; of a list, remove all."""
    place = place_of(location, value)
    holder = reduce(member, place if missing else place[:-1], value)
    if missing and isinstance(holder, dict):
        holder[location[-1]] = {"path": _MISSING} if location == ("bag",) else _MISSING
    elif isinstance(holder, dict) and place:
        del holder[place[-1]]
    elif isinstance(holder, list):
        holder.clear()
