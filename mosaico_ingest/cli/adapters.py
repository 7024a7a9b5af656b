"""`ingest adapters` and `ontology`: list, show, explain, try, test and draft adapters, and list ontology types."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from mosaico_ingest.cli.console import (
    PlainTable,
    Terminal,
    print_json,
    print_line,
    read_sources,
    render_findings,
)
from mosaico_ingest.cli.options import STANDARD_OUTPUT, JsonOption, write_output
from mosaico_ingest.display import counted, time_text

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import AdapterSpec
    from mosaico_ingest.adapters.standalone import DefinitionFinder
    from mosaico_ingest.services.adapters import Explained, Known, TestResult, TopicChoice, TriedMessage

adapters_app = typer.Typer(no_args_is_help=True, help="List, show, explain, try, test and draft adapters.")
TypeDistroOption = Annotated[
    str | None,
    typer.Option(
        "--ros-distro",
        help="Distro of the message types, such as ros2_humble; the newest if omitted.",
        metavar="DISTRO",
    ),
]
MsgDirOption = Annotated[
    list[str] | None,
    typer.Option(
        "--msg-dir",
        metavar="[PKG=]DIR",
        help="Folder with a package's .msg files. PKG defaults to the folder's name. Repeatable.",
    ),
]
_MAX_ITEMS = 4
"""Number of elements of a list that are shown."""
_MAX_STRUCTS = 2
"""Number of messages in a list that are shown."""
_MAX_TEXT = 60
"""Number of characters of a text that are shown."""
ontology_app = typer.Typer(no_args_is_help=True, help="List ontology types and show their fields.")


@adapters_app.command("list")
def list_adapters(
    takes: Annotated[
        str | None,
        typer.Option("--type", metavar="GLOB", help="Only adapters for these types, such as sensor_msgs/*."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the built-in adapters and the adapters of installed packages."""
    from msgspec import to_builtins

    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.services.adapters import known_adapters

    adapters = known_adapters(takes)
    if not adapters:
        raise NothingMatched(f"no adapter takes {takes!r}", hint="list all with `ingest adapters list`")
    if as_json:
        print_json([to_builtins(adapter) for adapter in adapters])
    else:
        print_adapters(adapters)


def print_adapters(adapters: Sequence[Known]) -> None:
    """Print a row for each adapter, dimmed if only an override can choose it."""
    from mosaico_ingest.rosbag.definitions.model import group_types

    table = PlainTable("adapter", "ontology", "takes", "from")
    for adapter in adapters:
        origin = adapter.origin if adapter.default else f"{adapter.origin}, by override"
        types = group_types(adapter.ros_types)
        table.add_row(adapter.name, adapter.ontology, types, origin, style=None if adapter.default else "dim")
    Terminal().print(table)


@adapters_app.command("show")
def show_adapter(
    adapter: Annotated[str, typer.Argument(metavar="NAME|FILE", help="An adapter's name or file.")],
) -> None:
    """Print an adapter's file."""
    from mosaico_ingest.services.adapters import source_text

    typer.echo(source_text(_find(adapter)), nl=False)


@adapters_app.command()
def explain(
    adapter: Annotated[
        str | None, typer.Argument(metavar="NAME|TYPE|FILE", help="An adapter, or a message type.")
    ] = None,
    *,
    job: Annotated[
        Path | None, typer.Option("--job", metavar="JOB.yaml", help="Explain every topic of a job.")
    ] = None,
    bag: Annotated[
        Path | None, typer.Option("--bag", metavar="BAG", help="Explain every topic of a recording.")
    ] = None,
    distro: TypeDistroOption = None,
    msg_dirs: MsgDirOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the origin of every column of an adapter, or the adapter of every topic and why it was chosen."""
    from msgspec import to_builtins

    from mosaico_ingest.services.adapters import explain_adapter, explain_topics

    if sum(option is not None for option in (adapter, job, bag)) != 1:
        raise typer.BadParameter("give one of NAME|TYPE|FILE, --job and --bag")
    if adapter is None:
        topics = explain_topics(job=job, bag=bag, distro=distro, custom=_packages(msg_dirs))
        if as_json:
            print_json([to_builtins(topic) for topic in topics], default=dict)
        else:
            print_topics(topics)
        return
    explanation = explain_adapter(adapter, _definition_finder(distro, msg_dirs))
    if as_json:
        print_json(to_builtins(explanation), default=dict)
    else:
        print_explanation(explanation)


def print_explanation(explanation: Explained) -> None:
    """Print the origin of every column, the fields without a column, and the alternatives."""
    adapter = explanation.description
    ontology = adapter.ontology or "the shape of the message"
    heading = Text.assemble((adapter.name, "bold"), f": {explanation.msgtype or 'any type'} → {ontology}")
    Terminal(soft_wrap=True).print(heading)
    if adapter.summary:
        print_line(adapter.summary, style="dim")
    if explanation.why:
        print_line(f"chosen because: {explanation.why}")
    elif not adapter.default:
        print_line("used only if an override names it")
    if len(adapter.takes) > 1:
        types = PlainTable("takes", "payload")
        for name, payload in adapter.takes.items():
            types.add_row(name, payload or "the message itself")
        Terminal().print(types)
    if adapter.columns:
        columns = PlainTable("column", "type", "", "comes from")
        for column in adapter.columns:
            required = "required" if column.required else ""
            origin = column.origin or Text("null", style="dim")
            columns.add_row(column.name, column.type, required, origin)
        Terminal().print(columns)
    if explanation.unread:
        print_line(f"fields without a column: {', '.join(explanation.unread)}", style="yellow")
    if explanation.others:
        print_line(f"also available by override: {', '.join(explanation.others)}")


def print_topics(topics: Sequence[TopicChoice]) -> None:
    """Print the adapter of each topic and why it was chosen, by recording."""
    for recording, choices in groupby(topics, key=lambda topic: topic.recording):
        print_line(recording, style="bold")
        table = PlainTable("topic", "type", "adapter", "becomes", "because")
        for topic in choices:
            cells = (topic.topic, topic.msgtype, topic.adapter or "-", topic.ontology or "-", topic.why)
            table.add_row(*cells, style=None if topic.adapter else "dim")
        Terminal().print(table)


@adapters_app.command("try")
def try_messages(
    adapter: Annotated[str, typer.Argument(metavar="NAME|FILE", help="An adapter's name or file.")],
    *,
    bag: Annotated[Path, typer.Option("--bag", metavar="BAG", help="Recording with the messages.")],
    topic: Annotated[str, typer.Option("--topic", metavar="TOPIC", help="Topic of the messages.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, metavar="N", help="Number of messages.")] = 5,
    values: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="NAME=VALUE", help="Value of a parameter. Repeatable."),
    ] = None,
    distro: TypeDistroOption = None,
    msg_dirs: MsgDirOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the first messages of a topic and the rows that an adapter derives from them, side by side.

    Exit codes: 0 no message is rejected, 4 a message is rejected.
    """
    from msgspec import to_builtins

    from mosaico_ingest.services.adapters import try_adapter

    spec = _find(adapter)
    types = _definition_finder(distro, msg_dirs)
    tried = try_adapter(spec, bag, topic, count, resolve=types, parameters=_parameters(values or ()))
    if as_json:
        print_json([to_builtins(one) for one in tried], default=list)
    else:
        print_trial(tried)
    if any(one.rejected for one in tried):
        raise typer.Exit(4)


@adapters_app.command("test")
def run_tests(
    adapters: Annotated[
        list[str] | None, typer.Argument(metavar="NAME|FILE", help="Adapters to test.")
    ] = None,
    test_all: Annotated[bool, typer.Option("--all", help="Test all built-in adapters.")] = False,
    distro: TypeDistroOption = None,
    msg_dirs: MsgDirOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check adapters against their message types, and run the tests in their files.

    Exit codes: 0 all tests pass, 1 a test or a check fails.
    """
    from mosaico_ingest.adapters.builtin import BUILTIN
    from mosaico_ingest.services.adapters import run_adapter_tests

    if bool(adapters) == test_all:
        raise typer.BadParameter("give adapters, or --all")
    specs = list(BUILTIN) if test_all else [_find(name) for name in adapters or ()]
    types = _definition_finder(distro, msg_dirs)
    results = [run_adapter_tests(spec, types) for spec in specs]
    if as_json:
        print_json([_result_json(result) for result in results])
    else:
        print_test_results(results)
    if not all(result.passed for result in results):
        raise typer.Exit(1)


def print_test_results(results: Sequence[TestResult]) -> None:
    """Print findings, failed tests, and the number of tests that passed."""
    from mosaico_ingest.rosbag.definitions.model import group_types

    for result in results:
        _print_test_result(result)
    outcomes = [outcome for result in results for outcome in result.outcomes]
    passed = sum(outcome.passed for outcome in outcomes)
    line = f"{counted(len(results), 'adapter')}, {passed} of {len(outcomes)} tests passed"
    mismatches = sum(bool(result.findings) for result in results)
    line += f", {counted(mismatches, 'adapter')} with findings" if mismatches else ""
    print_line(line, style="green" if all(result.passed for result in results) else "bold red")
    unknown = [name for result in results for name in result.unknown]
    if unknown:
        types = group_types(unknown)
        print_line(f"not checked against {types}: the definition is unknown; give --msg-dir", style="yellow")


@adapters_app.command()
def init(
    msgtype: Annotated[
        str, typer.Argument(metavar="TYPE", help="A message type, such as my_msgs/msg/Wheels.")
    ],
    *,
    bag: Annotated[
        Path | None, typer.Option("--bag", metavar="BAG", help="Recording that contains the type.")
    ] = None,
    job: Annotated[
        Path | None,
        typer.Option("--job", metavar="JOB.yaml", help="Manifest whose first recording contains the type."),
    ] = None,
    record: Annotated[
        str | None,
        typer.Option("--record", metavar="TOPIC", help="Add a test with this topic's first message."),
    ] = None,
    ontology: Annotated[
        str | None,
        typer.Option(
            "--ontology", metavar="TAG", help="Ontology type of the rows.", show_default="a new type"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write to this new file.", show_default="stdout"),
    ] = None,
    distro: TypeDistroOption = None,
    msg_dirs: MsgDirOption = None,
) -> None:
    """Draft an adapter with every field of the type; columns with the same name are filled in."""
    from mosaico_ingest.services.adapters import draft_adapter

    if bag is not None and job is not None:
        raise typer.BadParameter("give one of --bag and --job", param_hint="--job")
    if record is not None and bag is None and job is None:
        raise typer.BadParameter("needs a recording: give --bag or --job", param_hint="--record")
    if out is not None and out != STANDARD_OUTPUT and out.exists():
        raise typer.BadParameter(f"{out} exists", param_hint="--out")
    text = draft_adapter(
        msgtype,
        _definition_finder(distro, msg_dirs),
        bag=bag,
        job=job,
        record=record,
        ontology=ontology,
        folder=out.parent if out else Path(),
    )
    write_output(out or STANDARD_OUTPUT, text)
    if out is not None and out != STANDARD_OUTPUT:
        print_line(f"wrote {out}; test it with `ingest adapters test {out}`")


def print_trial(tried: Sequence[TriedMessage]) -> None:
    """Print each message with its rows."""
    for one in tried:
        rows = sum(len(of_output) for of_output in one.rows.values())
        print_line(f"message {one.index}, {time_text(one.log_time_ns)}: {counted(rows, 'row')}", style="bold")
        table = PlainTable("message", "value", "column", "row")
        left = list(_lines(one.message, ""))
        right = [line for name, of_output in one.rows.items() for line in _row_lines(name, of_output)]
        for (path, value), (column, stored) in zip_longest(left, right, fillvalue=("", "")):
            table.add_row(Text(path, style="dim"), value, Text(column, style="dim"), stored)
        Terminal().print(table)
        if one.rejected is not None:
            print_line(f"rejected {one.rejected}", style="red")
        if one.dropped is not None:
            print_line(f"dropped by `{one.dropped}`", style="yellow")
    rejected = sum(one.rejected is not None for one in tried)
    dropped = sum(one.dropped is not None for one in tried)
    line = f"{counted(len(tried), 'message')}: {len(tried) - rejected - dropped} written"
    print_line(f"{line}, {dropped} dropped, {rejected} rejected", style="red" if rejected else "green")


@ontology_app.command("ls")
def list_types(
    tag: Annotated[
        str | None, typer.Argument(metavar="GLOB", help="Only types whose tag matches, such as *Image.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the ontology types with the built-in adapters that produce them."""
    from msgspec import to_builtins

    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.services.schemas import known_ontologies

    types = known_ontologies(tag)
    if not types:
        raise NothingMatched(
            f"no ontology type matches {tag!r}", hint="list all types with `ingest ontology ls`"
        )
    if as_json:
        print_json([to_builtins(one) for one in types])
        return
    table = PlainTable("tag", "fields", "description", "adapters", numbers={"fields"})
    for one in types:
        table.add_row(one.tag, str(one.fields), one.summary, ", ".join(one.adapters))
    Terminal().print(table)


@ontology_app.command("show")
def show_type(
    tag: Annotated[str, typer.Argument(metavar="TAG", help="The tag of an ontology type, such as IMU.")],
    as_json: JsonOption = False,
) -> None:
    """Show the fields of an ontology type with their types, units, and whether they can be null."""
    from msgspec import to_builtins

    from mosaico_ingest.services.schemas import describe_ontology

    described = describe_ontology(tag)
    if as_json:
        print_json(to_builtins(described))
        return
    Terminal(soft_wrap=True).print(Text.assemble((described.tag, "bold"), f": {described.summary}"))
    print_line(f"format {described.format}, fingerprint {described.fingerprint}", style="dim")
    table = PlainTable("field", "type", "unit", "")
    for field in described.fields:
        table.add_row(field.name, field.type, field.unit, "nullable" if field.nullable else "required")
    Terminal().print(table)
    if described.adapters:
        print_line(f"produced by {', '.join(described.adapters)}")


def _parameters(options: Sequence[str]) -> dict[str, bool | int | float | str | None]:
    """Return the values of `--with NAME=VALUE`, read as YAML reads them."""
    from mosaico_ingest.job.yaml_source import resolve_plain

    parameters: dict[str, bool | int | float | str | None] = {}
    for option in options:
        name, equals, text = option.partition("=")
        if not equals:
            raise typer.BadParameter(f"{option!r} has no value; write NAME=VALUE", param_hint="--with")
        parameters[name] = resolve_plain(text)[0]
    return parameters


def _print_test_result(result: TestResult) -> None:
    if result.findings:
        console = Terminal(soft_wrap=True)
        console.print(render_findings(result.findings, read_sources(result.findings)))
    for outcome in result.outcomes:
        if not outcome.passed:
            print_line(f"{result.file}:{outcome.line}: {outcome.name}", style="red")
            for problem in outcome.problems:
                print_line(f"  {problem}")
    if not result.outcomes and not result.findings:
        print_line(f"{result.file}: has no tests", style="yellow")


def _find(adapter: str) -> AdapterSpec:
    from mosaico_ingest.services.adapters import find_adapter

    return find_adapter(adapter)


def _definition_finder(distro: str | None, msg_dirs: list[str] | None) -> DefinitionFinder:
    from mosaico_ingest.adapters.standalone import DefinitionFinder

    return DefinitionFinder(distro, _packages(msg_dirs))


def _packages(msg_dirs: list[str] | None) -> list[tuple[str, Path, None]]:
    """Return package, folder and distro of each option, in the form of `custom_msgs`."""
    packages: list[tuple[str, Path, None]] = []
    for option in msg_dirs or ():
        package, equals, folder = option.rpartition("=")
        path = Path(folder)
        default = path.resolve().parent.name if path.name == "msg" else path.resolve().name
        packages.append((package if equals else default, path, None))
    return packages


def _result_json(result: TestResult) -> dict[str, Any]:
    return {
        "adapter": result.name,
        "file": result.file,
        "passed": result.passed,
        "findings": [str(finding) for finding in result.findings],
        "unknown_types": list(result.unknown),
        "tests": [
            {
                "name": outcome.name,
                "line": outcome.line,
                "passed": outcome.passed,
                "problems": list(outcome.problems),
            }
            for outcome in result.outcomes
        ],
    }


def _row_lines(output: str, rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    for number, row in enumerate(rows):
        title = f"{output} {number + 1}".strip() if output or len(rows) > 1 else ""
        if title:
            yield f"{title}:", ""
        yield from _lines(row, "  " if title else "")


def _lines(values: dict[str, Any], prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the path and the value of each field; long lists and texts are shortened."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _lines(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for at, item in enumerate(value[:_MAX_STRUCTS]):
                yield from _lines(item or {}, f"{prefix}{name}[{at}].")
            if len(value) > _MAX_STRUCTS:
                yield f"{prefix}{name}", f"… {len(value)} elements"
        else:
            yield f"{prefix}{name}", _text(value)


def _text(value: Any) -> str:  # noqa: ANN401 - a value of a message or row
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list):
        items = ", ".join(_text(item) for item in value[:_MAX_ITEMS])
        return f"[{items}]" if len(value) <= _MAX_ITEMS else f"[{items}, … {len(value)} elements]"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = "null" if value is None else str(value)
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…"
