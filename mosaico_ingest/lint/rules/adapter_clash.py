"""The check of `adapter-clash`: two loaded adapters for the same message type."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.documents import read_limited
from mosaico_ingest.job.fields import reference_of
from mosaico_ingest.lint.check import Check, Job, Problem, find_module, load_mapping_source, python_reference
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype


def check(job: Job) -> Iterator[Problem]:
    """Report each adapter in `load` for a message type that an earlier adapter takes by default."""
    owners: dict[str, tuple[str, int]] = {}
    loaded = list(map(reference_of, job.manifest.adapters.load))
    for reference in dict.fromkeys(filter(job.is_expanded, loaded)):
        span = job.span("adapters", "load", loaded.index(reference))
        types = dict.fromkeys(map(normalize_msgtype, _default_types(job, reference)))
        for msgtype in types:
            if msgtype in owners:
                other, line = owners[msgtype]
                message = f"{reference} and {other} in line {line} both take {msgtype}"
                hint = "remove one, or set `default: false` in its file and name it in adapters.override"
                yield Problem(message, span, hint)
                break
        owners = {**dict.fromkeys(types, (reference, span.line)), **owners}


def _default_types(job: Job, reference: str) -> list[str]:
    """Return the message types that an adapter takes without an override, as far as they are literals."""
    python = python_reference(reference)
    if python is not None:
        file = job.resolve(python.module) if python.is_file else find_module(python.module, job.folder)
        return [] if file is None else _types_of_class(file, python.name)
    source = load_mapping_source(job.resolve(reference))
    if source is None or source.at(("default",)) is False:
        return []
    variants = source.at(("variants",))
    types = list(variants) if isinstance(variants, dict) else source.at(("ros_type",))
    return [name for name in (types if isinstance(types, list) else [types]) if isinstance(name, str)]


def _types_of_class(file: Path, name: str) -> list[str]:
    """Return the strings that a class assigns to `ros_msgtype`, without importing the class."""
    try:
        body = ast.parse(read_limited(file)).body
    except (OSError, SyntaxError, ValueError):
        return []
    statements = (
        item for node in body if isinstance(node, ast.ClassDef) and node.name == name for item in node.body
    )
    for item in statements:
        targets = item.targets if isinstance(item, ast.Assign) else [getattr(item, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == "ros_msgtype" for target in targets):
            value = getattr(item, "value", None)
            leaves = value.elts if isinstance(value, ast.Tuple | ast.List) else [value]
            return [
                leaf.value
                for leaf in leaves
                if isinstance(leaf, ast.Constant) and isinstance(leaf.value, str)
            ]
    return []


CHECK = Check("adapter-clash", job=check, reads_files=True)
