"""What a lint check reads and yields: jobs and `.msg` files in, problems out."""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from fnmatch import fnmatchcase
from functools import cache, reduce
from importlib.machinery import PathFinder
from pathlib import Path

from msgspec import Struct
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mosaico_ingest.documents import read_limited
from mosaico_ingest.findings import Edit, Finding, Span
from mosaico_ingest.job.fields import (
    AdapterRef,
    FilePath,
    PathRole,
    TopicGlob,
    marked_fields,
    reference_of,
    values_at,
)
from mosaico_ingest.job.manifest import check_manifest, combinations, fill_in
from mosaico_ingest.job.model import JobSettings, Manifest
from mosaico_ingest.job.validation import key_path_of
from mosaico_ingest.job.values import Stores
from mosaico_ingest.job.yaml_source import KeyPath, Source, Value, load_source, member
from mosaico_ingest.remote import without_options
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import distro_type
from mosaico_ingest.rules import RULES

_PLACEHOLDER = "missing"
"""Stands for a missing required string, so that the rest of the manifest can be checked."""
_MAX_REPAIRS = 50
_SUFFIXES = (".msg", ".idl")
_DECLARATION = re.compile(
    r"\s*(?P<type>[A-Za-z]\w*(?:/\w+)*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>\w+)\s*(?P<rest>.*)"
)


class Problem(Struct, frozen=True):
    """A violation of a rule, without the rule's id and severity."""

    message: str
    span: Span
    help: str | None = None
    fix: Edit | None = None


class Check(Struct, frozen=True):
    """The check of one rule, for jobs or for message definitions."""

    rule: str
    """The id of the rule."""
    job: Callable[[Job], Iterable[Problem]] | None = None
    message: Callable[[MessageFile], Iterable[Problem]] | None = None
    reads_files: bool = False
    """Whether the check looks at files next to the document. Such checks do not run on examples in Markdown pages."""

    def finding(self, problem: Problem) -> Finding:
        """Return a problem as a finding of this rule."""
        rule = RULES[self.rule]
        return Finding(rule.id, rule.severity, problem.message, problem.span, problem.help, problem.fix)


class Job(Struct, frozen=True):
    """A manifest without the values that its model rejects; those are reported separately."""

    manifest: Manifest
    source: Source
    folder: Path
    """The folder that relative paths start in."""
    file: Path | None = None
    """The manifest's file, or None for standard input and examples."""
    env: Mapping[str, str] | None = None
    """The environment variables; None leaves unset variables in the texts."""

    def span(self, *path: str | int) -> Span:
        """Return the span of a value."""
        return self.source.span(path)

    def key_span(self, *path: str | int) -> Span:
        """Return the span of a key."""
        return self.source.key_span(path)

    def has(self, *path: str | int) -> bool:
        """Return whether the manifest contains a value at a key path."""
        return path in self.source.spans

    def is_expanded(self, text: str | None) -> bool:
        """Return whether a string is present and all of its variables could be expanded."""
        return text is not None and "${" not in text and text != _PLACEHOLDER

    def resolve(self, path: str) -> Path:
        """Return a path of the manifest relative to the current directory."""
        return self.folder / Path(path).expanduser()


def read_job(
    source: Source, *, folder: Path, env: Mapping[str, str] | None, file: Path | None = None
) -> tuple[Job | None, tuple[Finding, ...]]:
    """Return the job, as far as it is valid, and the findings about its text and structure."""
    manifest, findings = check_manifest(source, env=env)
    if manifest is None and isinstance(source.value, dict):
        manifest = _valid_part(fill_in(source, env).value)
    return (None if manifest is None else Job(manifest, source, folder, file, env)), findings


def manifests_of_matrix(job: Job) -> Iterator[Manifest]:
    """Yield the manifest of each combination of the matrix that is valid; the manifest itself without a matrix."""
    yield job.manifest
    for cell in combinations(job.source.value)[1:]:
        manifest, _ = check_manifest(job.source, env=job.env, cell=cell)
        if manifest is not None:
            yield manifest


def _valid_part(value: Value) -> Manifest | None:
    """Remove the values that the model rejects until the rest is valid."""
    value = deepcopy(value)
    for _ in range(_MAX_REPAIRS):
        manifest, errors = _validate(value)
        if manifest is not None:
            return manifest
        for error in errors:
            _repair(value, error["loc"], missing=error["type"] == "missing")
    return None


def _validate(value: Value) -> tuple[Manifest | None, list[ErrorDetails]]:
    try:
        return Manifest.model_validate_json(json.dumps(value), strict=True), []
    except ValidationError as error:
        return None, error.errors(include_url=False, include_context=False)


def _repair(value: Value, location: KeyPath, *, missing: bool) -> None:
    """Remove the value at an error's location, empty the list that contains it, or add a placeholder if it is missing."""
    path = key_path_of(location, value)
    parent = reduce(member, path if missing else path[:-1], value)
    if missing and isinstance(parent, dict):
        parent[location[-1]] = {"path": _PLACEHOLDER} if location == ("bag",) else _PLACEHOLDER
    elif isinstance(parent, dict) and path:
        del parent[path[-1]]
    elif isinstance(parent, list):
        parent.clear()


def topic_patterns(job: Job) -> Iterator[tuple[str, str, Span]]:
    """Yield the section, the text and the span of every topic name and glob."""
    for i, pattern in enumerate(job.manifest.topics):
        yield "topics", pattern, job.span("topics", i)
    yield from keyed_patterns(job)
    for path, pattern in expected_patterns(job):
        yield ".".join(part for part in path if isinstance(part, str)), pattern, job.source.span(path)


def keyed_patterns(job: Job) -> Iterator[tuple[str, str, Span]]:
    """Yield the section, the text and the span of every key that is a topic name or glob, in order of precedence."""
    for field in marked_fields(JobSettings, TopicGlob):
        for path, mapping in values_at(job.source.value, field.path) if field.is_key else ():
            for key in mapping if isinstance(mapping, dict) else ():
                if isinstance(key, str) and key != field.marker.default:
                    yield ".".join(path), key, job.key_span(*path, key)


def expected_patterns(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield the key path and the text of each topic name and glob in the lists and values of `expect`."""
    for field in marked_fields(JobSettings, TopicGlob):
        if field.path[0] == "expect" and not field.is_key:
            for path, text in values_at(job.manifest, field.path):
                if isinstance(text, str) and text != field.marker.default:
                    yield path, text


def covers(general: str, special: str) -> bool:
    """Return whether `general` certainly matches every name that `special` matches."""
    if general in {"*", special}:
        return True
    if "[" in special:
        return False
    # NUL and /NUL/NUL replace the wildcards of `special`. Only a wildcard of `general` can match them.
    probes = (special.replace("*", filling).replace("?", "\x00") for filling in ("", "\x00", "/\x00/\x00"))
    return all(fnmatchcase(probe, general) for probe in probes)


def metadata_sections(job: Job) -> Iterator[KeyPath]:
    """Yield the key paths of the sequence's metadata and of each topic's metadata."""
    yield ("sequence", "metadata")
    for topic in job.manifest.topic_settings:
        yield ("topic_settings", topic, "metadata")


def value_paths_below(value: Value, path: KeyPath) -> Iterator[KeyPath]:
    """Yield the key path of every scalar inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from value_paths_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from value_paths_below(inner, (*path, i))
    else:
        yield path


def key_paths_below(value: Value, path: KeyPath) -> Iterator[KeyPath]:
    """Yield the key path of every key inside a value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key)
            yield from key_paths_below(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from key_paths_below(inner, (*path, i))


def recording_paths(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield the key path and the text of each expanded path in `bag.path`, without the options of URLs."""
    for path, text in manifest_paths(job, PathRole.RECORDING):
        yield path, without_options(text)


def manifest_paths(job: Job, *roles: PathRole) -> Iterator[tuple[KeyPath, str]]:
    """Yield the key path and the text of every expanded path in a manifest, or of the paths with these roles."""
    for field in marked_fields(JobSettings, FilePath):
        if not roles or field.marker.role in roles:
            for path, text in values_at(job.manifest, field.path):
                if isinstance(text, str) and path in job.source.spans and job.is_expanded(text):
                    yield path, text


class PythonReference(Struct, frozen=True):
    """A reference to a Python adapter: `module:Class` or `file.py:Class`."""

    module: str
    name: str

    @property
    def is_file(self) -> bool:
        """Whether the module is given as a file."""
        return self.module.endswith(".py")


def adapter_references(job: Job) -> Iterator[tuple[KeyPath, str]]:
    """Yield the key path and the text of every adapter reference."""
    for field in marked_fields(JobSettings, AdapterRef):
        values = values_at(job.manifest, field.path)
        yield from ((path, value) for path, value in values if isinstance(value, str))


def is_mapping_file(reference: str) -> bool:
    """Return whether an adapter reference is the path of an adapter file."""
    return reference.endswith((".yaml", ".yml"))


def python_reference(reference: str) -> PythonReference | None:
    """Return an adapter reference as a Python reference, or None for other references."""
    module, colon, name = reference.rpartition(":")
    return PythonReference(module, name) if colon and module and name else None


def loaded_names(job: Job) -> set[str] | None:
    """Return the names of the adapters in `adapters.load`, or None if one of them cannot be read."""
    names: set[str] = set()
    for reference in map(reference_of, job.manifest.adapters.load):
        python = python_reference(reference)
        if python is not None:
            names.add(python.name.rpartition(".")[2])
            continue
        source = load_mapping_source(job.resolve(reference))
        name = source.at(("adapter",)) if source is not None else None
        if not isinstance(name, str):
            return None
        names.add(name)
    return names


def load_mapping_source(file: Path) -> Source | None:
    """Return the YAML of an adapter file, or None if the file cannot be read."""
    try:
        return load_source(read_limited(file).decode(), file=str(file))
    except (OSError, UnicodeDecodeError):
        return None


def find_module(name: str, folder: Path) -> Path | None:
    """Return the source file of a module on Python's module path or in `folder`, or None. Does not import the module."""
    search_path: list[str] | None = [*sys.path, str(folder)]
    origin: str | None = None
    for i in range(name.count(".") + 1):
        spec = PathFinder.find_spec(".".join(name.split(".")[: i + 1]), search_path)
        if spec is None:
            return None
        origin, search_path = spec.origin, list(spec.submodule_search_locations or ())
    return Path(origin) if origin is not None and origin.endswith(".py") else None


def read_classes(file: Path) -> dict[str, bool]:
    """Return the top-level names of a Python file, and whether each of them can be an adapter.

    A class can be an adapter if it has a base class, `from_dict` or `bind`. Imported and assigned names can be adapters,
    because their values are unknown.

    Raises:
        SyntaxError: The file is not valid Python.
        OSError: The file cannot be read.
    """
    names: dict[str, bool] = {}
    for node in ast.parse(read_limited(file), str(file)).body:
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


class Declaration(Struct, frozen=True):
    """One line of a definition: a field or a constant."""

    type: str
    name: str
    is_constant: bool
    type_span: Span
    name_span: Span


class MessageFile(Struct, frozen=True):
    """The text of a message definition."""

    file: str
    text: str
    declarations: tuple[Declaration, ...]
    path: Path | None = None
    """The file that contains the text, or None."""

    @property
    def name(self) -> str:
        """The name of the type: the file name without `.msg`."""
        return Path(self.file).stem

    def lines(self) -> Iterator[tuple[Span, str]]:
        """Yield every line that is not blank, with its span."""
        for number, line in enumerate(self.text.splitlines(), 1):
            if line.strip():
                start = len(line) - len(line.lstrip()) + 1
                yield Span(self.file, number, start, number, len(line.rstrip()) + 1), line


def read_message(text: str, *, file: str, path: Path | None = None) -> MessageFile:
    """Return the declarations of a definition. Lines that are not declarations are skipped."""
    declarations = [
        _declaration(match, file, number)
        for number, line in enumerate(text.splitlines(), 1)
        if (match := _DECLARATION.fullmatch(_without_comment(line)))
    ]
    return MessageFile(file, text, tuple(declarations), path)


def is_defined(msgtype: str, path: Path | None) -> bool:
    """Return whether a type is defined next to the file at `path`, in a neighboring package, or in a ROS distribution."""
    package, _, name = msgtype.rpartition("/")
    if path is not None:
        package = package.removesuffix("/msg")
        folders = [path.parent] if not package else _package_folders(path.parent, package)
        if any((folder / f"{name}{suffix}").is_file() for folder in folders for suffix in _SUFFIXES):
            return True
    return bool(package) and _is_in_distro(normalize_msgtype(msgtype))


def _package_folders(folder: Path, package: str) -> list[Path]:
    """Return the folders that may contain the definitions of a package, given a folder that refers to it."""
    own = [folder] if package in {folder.name, folder.parent.name} else []
    parents = [folder.parent, folder.parent.parent]
    return own + [parent / package / inner for parent in parents for inner in ("", "msg")]


@cache
def _is_in_distro(msgtype: str) -> bool:
    return any(distro_type(distro, msgtype) is not None for distro in reversed(Stores))


def _without_comment(line: str) -> str:
    """Return a line without its comment. The value of a string constant may contain a `#`."""
    before = line.split("#", 1)[0]
    return (line if "=" in before else before).rstrip()


def _declaration(match: re.Match[str], file: str, number: int) -> Declaration:
    def span(group: str) -> Span:
        return Span(file, number, match.start(group) + 1, number, match.end(group) + 1)

    return Declaration(
        match["type"], match["name"], match["rest"].startswith("="), span("type"), span("name")
    )
