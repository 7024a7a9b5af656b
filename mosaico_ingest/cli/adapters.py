"""`ingest adapters`: list, show and explain adapters, run their tests, draft a new one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import to_builtins
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, plain_table, render_findings, texts_of
from mosaico_ingest.cli.report import open_console, print_json
from mosaico_ingest.report.units import counted

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import AdapterSpec
    from mosaico_ingest.adapters.standalone import DefinitionFinder
    from mosaico_ingest.services.adapters import (
        Explained,
        Known,
        TestResult,
        TopicChoice,
    )

__all__ = [
    "adapters_app",
    "print_adapters",
    "print_explained",
    "print_tests",
    "print_topics",
]


def print_adapters(known: Sequence[Known], *, as_json: bool) -> None:
    """Print adapters; those that have to be asked for are dim."""
    if as_json:
        _print_json([to_builtins(one) for one in known])
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
        _print_json(to_builtins(found))
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
        _print_json([to_builtins(one) for one in topics])
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


adapters_app = typer.Typer(no_args_is_help=True, help="List, show, explain, test and draft adapters.")

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Named = Annotated[str, typer.Argument(metavar="NAME|FILE", help="A name of the list, or an adapter file.")]
Distro = Annotated[
    str | None, typer.Option("--ros-distro", help="Whose message types; the newest where nothing is said.")
]
Folders = Annotated[
    list[str] | None,
    typer.Option(
        "--msg-dir",
        metavar="[PKG=]DIR",
        help="A package's .msg files; PKG is the folder's name where it is not given. Repeatable.",
    ),
]


@adapters_app.command("list")
def list_adapters(
    takes: Annotated[
        str | None,
        typer.Option("--type", metavar="GLOB", help="Only those for such message types, as sensor_msgs/*."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the built-in adapters and those of installed packages."""
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.services.adapters import known_adapters

    found = known_adapters(takes)
    if not found:
        raise NothingMatched(f"no adapter takes {takes!r}", hint="see `ingest adapters list`")
    print_adapters(found, as_json=as_json)


@adapters_app.command()
def show(adapter: Named) -> None:
    """Print an adapter's file, to read or to copy."""
    from mosaico_ingest.services.adapters import source_text

    typer.echo(source_text(_spec(adapter)), nl=False)


@adapters_app.command()
def explain(
    adapter: Annotated[
        str | None, typer.Argument(metavar="NAME|TYPE|FILE", help="An adapter, or a message type.")
    ] = None,
    *,
    job: Annotated[
        Path | None, typer.Option("--job", metavar="JOB.yaml", help="Every topic of a job.")
    ] = None,
    bag: Annotated[
        Path | None, typer.Option("--bag", metavar="BAG", help="Every topic of a recording.")
    ] = None,
    distro: Distro = None,
    folders: Folders = None,
    as_json: AsJson = False,
) -> None:
    """Say where every column comes from, what is left out, or which adapter each topic gets and why."""
    from mosaico_ingest.services.adapters import explain_adapter, explain_topics

    if sum(one is not None for one in (adapter, job, bag)) != 1:
        raise typer.BadParameter("give one of NAME|TYPE|FILE, --job and --bag")
    if adapter is None:
        print_topics(
            explain_topics(job=job, bag=bag, distro=distro, custom=_custom(folders)), as_json=as_json
        )
        return
    print_explained(explain_adapter(adapter, _types(distro, folders)), as_json=as_json)


@adapters_app.command("test")
def run_tests(
    adapters: Annotated[
        list[str] | None, typer.Argument(metavar="NAME|FILE", help="Adapters whose tests to run.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All built-in adapters.")] = False,
    distro: Distro = None,
    folders: Folders = None,
    as_json: AsJson = False,
) -> None:
    """Check adapter files against the message types they take, and run the tests in them.

    Exit codes: 0 all pass, 1 one fails or does not fit.
    """
    from mosaico_ingest.adapters.builtin import BUILTIN
    from mosaico_ingest.services.adapters import run_adapter_tests

    if bool(adapters) == every:
        raise typer.BadParameter("name adapters or files, or give --all")
    specs = list(BUILTIN) if every else [_spec(name) for name in adapters or ()]
    types = _types(distro, folders)
    results = [run_adapter_tests(spec, types) for spec in specs]
    print_tests(results, as_json=as_json)
    if not all(result.passed for result in results):
        raise typer.Exit(1)


@adapters_app.command()
def init(
    msgtype: Annotated[str, typer.Argument(metavar="TYPE", help="A message type, as my_msgs/msg/Wheels.")],
    *,
    bag: Annotated[
        Path | None, typer.Option("--bag", metavar="BAG", help="A recording that has the type.")
    ] = None,
    record: Annotated[
        str | None,
        typer.Option("--record", metavar="TOPIC", help="Make a test of this topic's first message."),
    ] = None,
    ontology: Annotated[
        str | None,
        typer.Option("--ontology", metavar="TAG", help="What it becomes.", show_default="a type of its own"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write it there, if nothing is there.")
    ] = None,
    distro: Distro = None,
    folders: Folders = None,
) -> None:
    """Write a first draft of an adapter: every field of the type, guesses by equal names."""
    from mosaico_ingest.services.adapters import draft_adapter
    from mosaico_ingest.textfile import write_whole

    if record is not None and bag is None:
        raise typer.BadParameter("it is read from a recording: give --bag", param_hint="--record")
    if out is not None and out.exists():
        raise typer.BadParameter(f"{out} is there already", param_hint="--out")
    text = draft_adapter(
        msgtype,
        _types(distro, folders),
        bag=bag,
        record=record,
        ontology=ontology,
        folder=out.parent if out else Path(),
    )
    if out is None:
        typer.echo(text, nl=False)
        return
    write_whole(out, text)
    typer.echo(f"{out} written; try it: ingest adapters test {out}")


def _spec(adapter: str) -> AdapterSpec:
    from mosaico_ingest.services.adapters import find_adapter

    return find_adapter(adapter)


def _types(distro: str | None, folders: list[str] | None) -> DefinitionFinder:
    from mosaico_ingest.adapters.standalone import DefinitionFinder

    return DefinitionFinder(distro, _custom(folders))


def _custom(folders: list[str] | None) -> list[tuple[str, Path, None]]:
    """Return packages and their folders, as `custom_msgs` has them."""
    custom: list[tuple[str, Path, None]] = []
    for given in folders or ():
        package, equals, folder = given.rpartition("=")
        path = Path(folder)
        own = path.resolve().parent.name if path.name == "msg" else path.resolve().name
        custom.append((package if equals else own, path, None))
    return custom
