"""This file looks adapters up by what a job calls them, without importing a line of them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path

from mosaico_ingest.frozen import frozen
from mosaico_ingest.lint.job import Job
from mosaico_ingest.manifest.source import Path as Place
from mosaico_ingest.manifest.source import load_source
from mosaico_ingest.textfile import read_whole

__all__ = [
    "PythonReference",
    "adapter_references",
    "find_module",
    "is_mapping_file",
    "loaded_names",
    "python_reference",
    "read_classes",
]


@frozen
class PythonReference:
    """`module:Class` or `file.py:Class`."""

    module: str
    name: str

    @property
    def is_file(self) -> bool:
        """Whether the module is given as a file."""
        return self.module.endswith(".py")


def adapter_references(job: Job) -> Iterator[tuple[Place, str]]:
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
