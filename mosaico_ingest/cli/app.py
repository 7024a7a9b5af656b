"""This file is the `ingest` command: its subcommands in one list, and the one place an error becomes an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

import typer

from mosaico_ingest.cli import (
    adapters,
    bag,
    diff,
    expand,
    export,
    init,
    inspect,
    keys,
    lint,
    plan,
    replay,
    report,
    run,
    schema,
    serve,
    status,
    store,
    verify,
    watch,
)
from mosaico_ingest.cli.collector import collect_rarely
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.version import __version__

__all__ = ["app", "main"]

COMMANDS: tuple[tuple[str, Callable[..., Any]], ...] = (
    ("run", run.run),
    ("bag", bag.bag),
    ("inspect", inspect.inspect),
    ("plan", plan.plan),
    ("diff", diff.diff),
    ("init", init.init),
    ("expand", expand.expand),
    ("verify", verify.verify),
    ("replay", replay.replay),
    ("export", export.export),
    ("lint", lint.lint),
    ("serve", serve.serve),
    ("watch", watch.watch),
    ("status", status.status),
    ("report", report.report),
    ("schema", schema.schema),
)
"""In the order `--help` lists them."""

GROUPS: tuple[tuple[str, typer.Typer], ...] = (
    ("adapters", adapters.app),
    ("store", store.app),
    ("keys", keys.app),
)

app = typer.Typer(
    name="ingest",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Turn ROS recordings into typed, queryable sequences. `ingest job.yaml` runs a job.",
)
for _name, _command in COMMANDS:
    app.command(_name)(_command)
for _name, _group in GROUPS:
    app.add_typer(_group, name=_name)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mosaico-ingest {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Turn ROS recordings into typed, queryable sequences. `ingest job.yaml` runs a job."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    collect_rarely()
    # numpy's OpenBLAS starts a thread for each core, and idle ones spin: 40 ms of CPU, and nothing here multiplies matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app(_with_command([argument for argument in given if argument != "--debug"]), prog_name="ingest")
    except IngestError as error:
        if debug:
            raise
        _complain(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        if debug:
            raise
        sys.exit(Interrupted.exit_code)
    except BrokenPipeError:
        # The reader of our output has gone, as in `ingest inspect x | head`: that is no error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _with_command(arguments: list[str]) -> list[str]:
    """Put `run` before a manifest that is given alone, and say what is meant by an unknown word."""
    known = [name for name, _ in COMMANDS] + [name for name, _ in GROUPS]
    first = next((argument for argument in arguments if not argument.startswith("-")), None)
    if first is None or first in known:
        return arguments
    if first.endswith((".yaml", ".yml")) or "/" in first or Path(first).exists():
        return ["run", *arguments]
    near = get_close_matches(first, known, n=1)
    hint = (
        f"did you mean `ingest {near[0]}`?" if near else "see `ingest --help`; a job is given as a .yaml file"
    )
    typer.echo(f"error: no command or manifest {first!r} — {hint}", err=True)
    sys.exit(2)


def _complain(error: IngestError) -> None:
    from mosaico_ingest.cli.errors import print_error

    print_error(str(error), error.findings)


if __name__ == "__main__":
    main()
