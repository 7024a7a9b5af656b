"""The `ingest` command: its subcommands, and the conversion of errors to exit codes."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.cli.process import collect_rarely
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.version import __version__

__all__ = ["command_line", "main"]

COMMANDS = {
    "run": "run", "bag": "run", "inspect": "report", "plan": "plan", "diff": "plan", "init": "plan", "expand": "plan",
    "verify": "store", "replay": "run", "export": "export", "lint": "lint", "serve": "serve", "watch": "watch",
    "status": "watch", "report": "report", "schema": "lint",
}  # fmt: skip
"""Each command is the function of its name in this module of `cli`; in the order `--help` lists them."""
GROUPS = {"adapters": "adapters", "store": "store", "keys": "serve"}
"""Each command group is the Typer application `<name>_app` in this module of `cli`."""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mosaico-ingest {__version__}")
        raise typer.Exit


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Turn ROS recordings into typed, queryable sequences. `ingest job.yaml` runs a job."""


def command_line(names: Sequence[str] = (*COMMANDS, *GROUPS)) -> typer.Typer:
    """Return the command line with these commands: typer takes 27 ms to take all of them apart, whichever is called."""
    app = typer.Typer(
        name="ingest",
        callback=root,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
    )
    for name in names:
        if name in GROUPS:
            module = import_module(f"{__package__}.{GROUPS[name]}")
            app.add_typer(getattr(module, f"{name}_app"), name=name)
        else:
            module = import_module(f"{__package__}.{COMMANDS[name]}")
            app.command(name)(getattr(module, name))
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    collect_rarely()
    # numpy's OpenBLAS starts a thread for each core, and idle ones spin: 40 ms of CPU, and nothing here multiplies matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as standard error is: a file may have any name
    try:
        _run(_with_command([argument for argument in given if argument != "--debug"]))
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
    except OSError as error:  # a full disk, a file that may not be written: no mistake of ours
        if debug:
            raise
        _complain(IngestError(error.strerror or str(error), where=error.filename and str(error.filename)))
        sys.exit(IngestError.exit_code)


def _run(asked: list[str]) -> None:
    named = asked[:1] if asked and asked[0] in {*COMMANDS, *GROUPS} else (*COMMANDS, *GROUPS)
    try:
        command_line(named)(asked, prog_name="ingest")
    except SystemExit as leave:
        if isinstance(leave.__context__, BrokenPipeError):  # typer leaves with 1 then
            raise leave.__context__ from None
        raise


def _with_command(arguments: list[str]) -> list[str]:
    """Put `run` before a manifest that is given alone, and say what is meant by an unknown word."""
    known = (*COMMANDS, *GROUPS)
    first = next((argument for argument in arguments if not argument.startswith("-")), None)
    if first is None or first in known:
        return arguments
    suffixes = (".yaml", ".yml")
    is_value = first != arguments[0] and any(argument.endswith(suffixes) for argument in arguments)
    if first.endswith(suffixes) or is_value:
        return ["run", *arguments]
    if first.endswith((".bag", ".db3", ".mcap", ".zstd")) or Path(first).is_dir():
        from shlex import quote

        bag = quote(first)
        hint = f"`ingest bag {bag} --name NAME` ingests it, `ingest init {bag}` drafts a manifest"
        typer.echo(f"error: {first} is no manifest — {hint}", err=True)
        sys.exit(2)
    if "/" in first or Path(first).exists():
        return ["run", *arguments]
    near = get_close_matches(first, known, n=1)
    hint = (
        f"did you mean `ingest {near[0]}`?" if near else "see `ingest --help`; a job is given as a .yaml file"
    )
    typer.echo(f"error: no command or manifest {first!r} — {hint}", err=True)
    sys.exit(2)


def _complain(error: IngestError) -> None:
    from mosaico_ingest.cli.console import print_error

    print_error(str(error), error.findings)


if __name__ == "__main__":
    main()
