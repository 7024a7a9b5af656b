"""The structure of the package: size of files and functions, import cycles, names and docstrings."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mosaico_ingest"
FILES = sorted(PACKAGE.rglob("*.py"))
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "manager"}

GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
REPLACED = tuple(
    term
    for row in GLOSSARY.split("<!-- replaced terms -->")[1].split("<!-- end of")[0].splitlines()
    for term in re.findall(r"`(\w+)`", row)
)
"""Terms that no name may contain, in snake case; plurals with `s` count too."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def body_lines(function: Function) -> int:
    """Return the number of lines without the signature and the docstring."""
    body = function.body
    docstring = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    first = body[1] if docstring and len(body) > 1 else body[0]
    return (function.end_lineno or 0) - first.lineno + 1


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_at_load_time(path: Path, modules: set[str]) -> set[str]:
    """Return the modules of the package that a module imports at module level."""
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


def test_module_imports_have_no_cycle() -> None:
    modules = {module_name(path) for path in FILES}
    graph = {module_name(path): imports_at_load_time(path, modules) for path in FILES}
    assert sum(map(len, graph.values())) > len(FILES)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_module_names_are_specific() -> None:
    assert not [path for path in FILES if path.stem in VAGUE]


def test_modules_and_packages_have_docstrings() -> None:
    assert not [path for path in FILES if not ast.get_docstring(tree(path))]


def test_package_docstrings_have_at_least_two_sentences() -> None:
    packages = [path for path in FILES if path.name == "__init__.py"]
    short = [
        path for path in packages if len(re.findall(r"\.(?:\s|$)", ast.get_docstring(tree(path)) or "")) < 2
    ]
    assert not short


def docstrings(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the docstrings of a module, its classes and its functions, with their lines."""
    for node in ast.walk(tree(path)):
        if isinstance(node, (ast.Module, ast.ClassDef, *Function.__args__)):
            docstring = ast.get_docstring(node)
            if docstring:
                yield docstring, getattr(node, "lineno", 1)


def test_docstrings_do_not_start_with_this_file() -> None:
    uses = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in FILES
        for docstring, line in docstrings(path)
        if docstring.startswith("This file")
    ]
    assert not uses


def words(name: str) -> str:
    """Return a name in snake case, between underscores."""
    pieces = re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+", name)
    return f"_{'_'.join(pieces).lower()}_"


def defined_names(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the names that a module defines, with their lines: itself, classes, functions, parameters, variables, attributes."""
    yield path.stem, 1
    for node in ast.walk(tree(path)):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name, node.lineno
            case ast.arg(arg=name):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, node.lineno
            case _:
                pass


def test_glossary_lists_replaced_terms() -> None:
    assert "place" in REPLACED
    assert len(REPLACED) > 10


@pytest.mark.parametrize("term", REPLACED)
def test_no_name_contains_a_replaced_term(term: str) -> None:
    uses = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path in FILES
        for name, line in defined_names(path)
        if re.search(f"_{term}s?_", words(name))
    ]
    assert not uses
