"""This file is `ingest adapters`: list, show and explain adapters, run their tests, draft a new one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import AdapterSpec
    from mosaico_ingest.adapters.definitions import KnownTypes

__all__ = ["app"]

app = typer.Typer(no_args_is_help=True, help="List, show, explain, test and draft adapters.")

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


@app.command("list")
def list_adapters(
    takes: Annotated[
        str | None,
        typer.Option("--type", metavar="GLOB", help="Only those for such message types, as sensor_msgs/*."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the built-in adapters and those of installed packages."""
    from mosaico_ingest.cli.adapters_tables import print_adapters
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.executors.adapters import known_adapters

    found = known_adapters(takes)
    if not found:
        raise NothingMatched(f"no adapter takes {takes!r}", hint="see `ingest adapters list`")
    print_adapters(found, as_json=as_json)


@app.command()
def show(adapter: Named) -> None:
    """Print an adapter's file, to read or to copy."""
    from mosaico_ingest.executors.adapters import source_text

    typer.echo(source_text(_spec(adapter)), nl=False)


@app.command()
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
    from mosaico_ingest.cli.adapters_tables import print_explained, print_topics
    from mosaico_ingest.executors.adapters import explain_adapter, explain_topics

    if sum(one is not None for one in (adapter, job, bag)) != 1:
        raise typer.BadParameter("give one of NAME|TYPE|FILE, --job and --bag")
    if adapter is None:
        print_topics(
            explain_topics(job=job, bag=bag, distro=distro, custom=_custom(folders)), as_json=as_json
        )
        return
    print_explained(explain_adapter(adapter, _types(distro, folders)), as_json=as_json)


@app.command("test")
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
    from mosaico_ingest.cli.adapters_tables import print_tests
    from mosaico_ingest.executors.adapters import run_adapter_tests

    if bool(adapters) == every:
        raise typer.BadParameter("name adapters or files, or give --all")
    specs = list(BUILTIN) if every else [_spec(name) for name in adapters or ()]
    types = _types(distro, folders)
    results = [run_adapter_tests(spec, types) for spec in specs]
    print_tests(results, as_json=as_json)
    if not all(result.passed for result in results):
        raise typer.Exit(1)


@app.command()
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
    from mosaico_ingest.executors.adapters import draft_adapter
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
    from mosaico_ingest.executors.adapters import find_adapter

    return find_adapter(adapter)


def _types(distro: str | None, folders: list[str] | None) -> KnownTypes:
    from mosaico_ingest.adapters.definitions import KnownTypes

    return KnownTypes(distro, _custom(folders))


def _custom(folders: list[str] | None) -> list[tuple[str, Path, None]]:
    """Return packages and their folders, as `custom_msgs` has them."""
    custom: list[tuple[str, Path, None]] = []
    for given in folders or ():
        package, equals, folder = given.rpartition("=")
        path = Path(folder)
        own = path.resolve().parent.name if path.name == "msg" else path.resolve().name
        custom.append((package if equals else own, path, None))
    return custom
