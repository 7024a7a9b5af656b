"""This file prints what is known of adapters: lists, explanations, the results of their tests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, plain_table
from mosaico_ingest.cli.render import render_findings, texts_of
from mosaico_ingest.cli.tables import open_console, print_json
from mosaico_ingest.executors.adapters import Explained, Known, TestResult, TopicChoice
from mosaico_ingest.report.units import counted

__all__ = ["print_adapters", "print_explained", "print_tests", "print_topics"]


def print_adapters(known: Sequence[Known], *, as_json: bool) -> None:
    """Print adapters; those that have to be asked for are dim."""
    if as_json:
        _print_json([asdict(one) for one in known])
        return
    table = plain_table("adapter", "ontology", "takes", "from")
    for one in known:
        used = one.origin if one.default else f"{one.origin}, by override"
        style = None if one.default else "dim"
        table.add_row(one.name, one.ontology, _short(one.ros_types), used, style=style)
    open_console().print(table)


def _short(names: Sequence[str]) -> str:
    """Return types with each package named once, as `sensor_msgs: Image, Imu`."""
    pairs = sorted((name.partition("/")[0], name.rpartition("/")[2]) for name in names)
    groups = groupby(pairs, key=lambda pair: pair[0])
    return "; ".join(f"{package}: {', '.join(short for _, short in some)}" for package, some in groups)


def print_explained(found: Explained, *, as_json: bool) -> None:
    """Print where every column comes from, and what is left out."""
    if as_json:
        _print_json(asdict(found))
        return
    console, words = open_console(), found.description
    becomes = words.ontology or "its own shape"
    console.print(Text.assemble((words.name, "bold"), f": {found.msgtype or 'any type'} → {becomes}"))
    if words.summary:
        console.print(Text(words.summary, style="dim"), soft_wrap=True)
    if found.why:
        console.print(f"chosen because: {found.why}", highlight=False)
    elif not words.default:
        console.print("used only where an override names it", highlight=False)
    if len(words.takes) > 1:
        console.print(_taken(words.takes))
    if words.columns:
        table = plain_table("column", "type", "", "comes from")
        for column in words.columns:
            need = "required" if column.required else ""
            table.add_row(column.name, column.type, need, column.origin or Text("null", style="dim"))
        console.print(table)
    if found.unread:
        console.print(
            Text(f"left out of the message: {', '.join(found.unread)}", style="yellow"), soft_wrap=True
        )
    if found.others:
        console.print(f"by override also: {', '.join(found.others)}", highlight=False, soft_wrap=True)


def _taken(takes: Mapping[str, str]) -> Table:
    table = plain_table("takes", "whose payload is")
    for name, of in takes.items():
        table.add_row(name, of or "the message itself")
    return table


def print_topics(topics: Sequence[TopicChoice], *, as_json: bool) -> None:
    """Print which adapter each topic gets, and why."""
    if as_json:
        _print_json([asdict(one) for one in topics])
        return
    console = open_console()
    for recording, some in groupby(topics, key=lambda one: one.recording):
        console.print(Text(recording, style="bold"))
        table = plain_table("topic", "type", "adapter", "becomes", "because")
        for one in some:
            cells = (one.topic, one.msgtype, one.adapter or "-", one.ontology or "-", one.why)
            table.add_row(*cells, style=None if one.adapter else "dim")
        console.print(table)


def print_tests(results: Sequence[TestResult], *, as_json: bool) -> None:
    """Print what failed, where, and how many tests passed."""
    if as_json:
        _print_json([_result(one) for one in results])
        return
    console = Terminal(soft_wrap=True)
    for one in results:
        _print_result(one, console)
    tests = [outcome for one in results for outcome in one.outcomes]
    line = (
        f"{counted(len(results), 'adapter')}, {sum(one.passed for one in tests)} of {len(tests)} tests passed"
    )
    misfits = sum(bool(one.findings) for one in results)
    line += f", {misfits} do not fit their types" if misfits else ""
    style = "green" if all(one.passed for one in results) else "bold red"
    console.print(Text(line, style=style))
    unknown = [name for one in results for name in one.unknown]
    if unknown:
        line = f"not checked against {_short(unknown)}: no definition is known — give --msg-dir"
        console.print(Text(line, style="yellow"))


def _print_result(result: TestResult, console: Console) -> None:
    if result.findings:
        console.print(render_findings(result.findings, texts_of(result.findings)))
    for outcome in result.outcomes:
        if not outcome.passed:
            console.print(Text(f"{result.file}:{outcome.line}: {outcome.name}", style="red"))
            for problem in outcome.problems:
                console.print(Text(f"  {problem}"))
    if not result.outcomes and not result.findings:
        console.print(Text(f"{result.file}: has no tests", style="yellow"))


def _result(result: TestResult) -> dict[str, Any]:
    return {
        "adapter": result.name,
        "file": result.file,
        "passed": result.passed,
        "findings": [str(finding) for finding in result.findings],
        "unknown_types": list(result.unknown),
        "tests": [
            {"name": one.name, "line": one.line, "passed": one.passed, "problems": list(one.problems)}
            for one in result.outcomes
        ],
    }


def _print_json(value: object) -> None:
    print_json(json.dumps(value, indent=2, ensure_ascii=False, default=dict))
