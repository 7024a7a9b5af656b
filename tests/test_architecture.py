"""The structure of the package: size of files and functions, import cycles, and module names."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mosaico_ingest"
FILES = sorted(PACKAGE.rglob("*.py"))
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "manager"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def body_lines(function: Function) -> int:
    """Lines from the first statement after the docstring to the last."""
    body = function.body
    docstring = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    first = body[1] if docstring and len(body) > 1 else body[0]
    return (function.end_lineno or 0) - first.lineno + 1


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_at_load_time(path: Path, modules: set[str]) -> set[str]:
    """The package's modules that `path` imports when it is imported itself."""
    names = [
        f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in modules else str(node.module)
        for node in tree(path).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    return {name for name in names if name in modules} - {module_name(path)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_file_has_at_most_800_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 800


def test_functions_have_at_most_80_lines() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name} has {body_lines(node)} lines"
        for path in FILES
        for node in ast.walk(tree(path))
        if isinstance(node, Function) and body_lines(node) > 80
    ]
    assert not long


def test_modules_do_not_import_each_other_in_cycles() -> None:
    modules = {module_name(path) for path in FILES}
    graph = {module_name(path): imports_at_load_time(path, modules) for path in FILES}
    assert sum(map(len, graph.values())) > len(FILES)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_module_names_are_specific() -> None:
    assert not [path for path in FILES if path.stem in VAGUE]


def test_modules_have_docstrings() -> None:
    assert not [path for path in FILES if not ast.get_docstring(tree(path))]
