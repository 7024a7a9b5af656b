"""The size of files and functions, the share of docstrings, and names that say nothing."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mosaico_ingest"
FILES = sorted(PACKAGE.rglob("*.py"))
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "manager"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def functions(path: Path) -> list[Function]:
    return [node for node in ast.walk(tree(path)) if isinstance(node, Function)]


def body_lines(function: Function) -> int:
    """Lines from the first statement after the docstring to the last."""
    body = function.body
    docstring = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    first = body[1] if docstring and len(body) > 1 else body[0]
    return (function.end_lineno or 0) - first.lineno + 1


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_is_at_most_400_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400


def test_a_function_is_at_most_50_lines() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{function.lineno} {function.name} has {body_lines(function)} lines"
        for path in FILES
        if "cli" not in path.parts  # a command's signature is its option table
        for function in functions(path)
        if body_lines(function) > 50
    ]
    assert not long


def test_half_of_the_functions_have_at_most_12_lines() -> None:
    assert median(body_lines(function) for path in FILES for function in functions(path)) <= 12


def test_docstrings_are_at_most_a_quarter_of_the_lines() -> None:
    total = documented = 0
    for path in FILES:
        if "rules" in path.parts:  # a rule's docstring is its page
            continue
        total += sum(bool(line.strip()) for line in path.read_text().splitlines())
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node):
                text = node.body[0]
                documented += (text.end_lineno or 0) - text.lineno + 1
    assert documented / total <= 0.25


def test_no_module_has_a_name_that_says_nothing() -> None:
    assert not [path for path in FILES if path.stem in VAGUE]


def test_every_module_says_what_it_is() -> None:
    assert not [path for path in FILES if not ast.get_docstring(tree(path))]
