"""The `ingest` command: its subcommands, the exit codes of errors, and shell completion."""

from __future__ import annotations

import io
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from mosaico_ingest.cli.process import defer_garbage_collection
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.findings import one_line
from mosaico_ingest.version import __version__

COMMANDS = {
    "run": "run", "bag": "run", "inspect": "report", "plan": "plan", "check": "check", "diff": "plan",
    "init": "manifests", "expand": "manifests", "view": "export", "verify": "store", "replay": "run", "export": "export",
    "lint": "check", "serve": "serve", "browse": "serve", "watch": "serve", "status": "serve", "report": "report",
    "quickstart": "manifests",
}  # fmt: skip
"""The module in `cli` that defines each command, in the order of `--help`."""
GROUPS = {
    "adapters": "adapters",
    "ontology": "adapters",
    "store": "store",
    "keys": "serve",
    "schema": "manifests",
}
"""The module in `cli` that defines each command group, as the Typer application `<name>_app`."""
GROUP_HELP = {
    "adapters": "List, show, explain, try, test and draft adapters.",
    "ontology": "List ontology types and show their fields.",
    "store": "List, show, query and remove the sequences of a store.",
    "keys": "Create and list the API keys of `ingest serve`.",
}
"""The help of groups whose commands `ingest --help` need not import."""
NO_PYTHON = "MOSAICO_NO_PYTHON"
"""As `adapters.python.NO_PYTHON`, which takes longer to import."""
NAMES = (*COMMANDS, *GROUPS)
COMPLETING = "_INGEST_COMPLETE" in os.environ
"""Whether a shell asks for completions."""
MANIFEST_SUFFIXES = (".yaml", ".yml")
MAX_NAMES = 500
"""Maximum number of proposals."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    if "--no-python" in words:
        os.environ[NO_PYTHON] = "1"
    defer_garbage_collection()
    # OpenBLAS, which NumPy loads, starts a thread for each core. They take 40 ms of CPU, and no code here uses them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be valid text
    try:
        _invoke(_add_command([word for word in words if word not in {"--debug", "--no-python"}]))
    except IngestError as error:
        if debug:
            raise
        _print_error(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        if debug:
            raise
        sys.exit(Interrupted.exit_code)
    except BrokenPipeError:
        # The reader of the output is gone, as in `ingest inspect x | head`, which is not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:  # such as a full disk or a file without write permission
        if debug:
            raise
        _print_error(IngestError(error.strerror or str(error), where=error.filename and str(error.filename)))
        sys.exit(IngestError.exit_code)


def command_line(names: Sequence[str] = NAMES, *, lists_only: bool = False) -> typer.Typer:
    """Return the command line with these commands, which take 40 ms to import and inspect.

    With `lists_only`, groups have their help but no commands, which takes half the time.
    """
    app = typer.Typer(
        name="ingest",
        cls=_Group,
        callback=root,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
    )
    for name in names:
        if lists_only and name in GROUP_HELP:
            app.add_typer(typer.Typer(help=GROUP_HELP[name]), name=name, cls=_Group)
        elif name in GROUPS:
            module = import_module(f"{__package__}.{GROUPS[name]}")
            group: typer.Typer = getattr(module, f"{name}_app")
            for command in group.registered_commands:
                command.cls = _Command
            app.add_typer(group, name=name, cls=_Group)
        else:
            module = import_module(f"{__package__}.{COMMANDS[name]}")
            app.command(name, cls=_Command)(getattr(module, name))
    return app


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"mosaico-ingest {__version__}")
        raise typer.Exit


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Print the traceback of an error.")] = False,
    no_python: Annotated[
        bool,
        typer.Option("--no-python", envvar=NO_PYTHON, show_envvar=True, help="Refuse adapters in Python."),
    ] = False,
) -> None:
    """Turn ROS recordings into typed, queryable sequences. `ingest job.yaml` runs a job."""


def completer(metavar: str | None) -> Callable[[Any, Any, str], list[str]] | None:
    """Return the function that completes values with this metavar, or None."""
    source = _SOURCES.get(metavar or "")
    if source is None:
        return None

    def complete(context: Any, _parameter: Any, incomplete: str) -> list[str]:  # noqa: ANN401 - classes of typer or click
        try:
            names = source(str(context.params.get("store") or "mosaico"), incomplete)
            return sorted(name for name in names if name.startswith(incomplete))[:MAX_NAMES]
        except (IngestError, OSError):
            return []  # without a store there is nothing to propose

    return complete


def _suggest() -> bool:
    """Print commands for the recordings and manifests of the current folder; return whether there are any."""
    from mosaico_ingest.cli.manifests import suggestions

    lines = suggestions(Path())
    if lines:
        typer.echo("\n".join(["This folder contains", *lines, "All commands: ingest --help"]))
    return bool(lines)


def _invoke(words: list[str]) -> None:
    if not words and not COMPLETING and _suggest():
        sys.exit(2)
    try:
        lists_only = not COMPLETING and words in ([], ["--help"], ["-h"])
        names = words[:1] if words and words[0] in NAMES else NAMES
        command_line(names, lists_only=lists_only)(words, prog_name="ingest")
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # typer exits with 1 in this case
            raise error.__context__ from None
        raise


class _Command(TyperCommand):
    """A command whose help shows no Python types."""

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401 - the context of typer or click, by version
        return _without_types(super().get_params(ctx))


class _Group(TyperGroup):
    """A command group whose help shows no Python types."""

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401 - the context of typer or click, by version
        return _without_types(super().get_params(ctx))


def _without_types(parameters: Sequence[Any]) -> list[Any]:
    """Return the parameters without the type of flags and of arguments that have a metavar, such as `<bool>`."""
    for parameter in parameters:
        if getattr(parameter, "is_flag", False) or (
            isinstance(parameter, TyperArgument) and parameter.metavar
        ):
            parameter.display_type_rich = _no_type
        if COMPLETING and (complete := completer(parameter.metavar)) is not None:
            # Typer has no public way to complete parameters that exist.
            parameter._custom_shell_complete = complete  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]
    return list(parameters)


def _no_type(ctx: object) -> None:
    """Return no text for the column of types."""


def _add_command(words: list[str]) -> list[str]:
    """Return the words with `run` before a manifest; exit with a hint if the first word is unknown."""
    first = next((word for word in words if not word.startswith("-")), None)
    if first is None or first in NAMES or words[0] in {"--show-completion", "--install-completion"}:
        return words
    is_option_value = first != words[0] and any(word.endswith(MANIFEST_SUFFIXES) for word in words)
    if first.endswith(MANIFEST_SUFFIXES) or is_option_value:
        return ["run", *words]
    from mosaico_ingest.containers import RECORDING_NAME

    if RECORDING_NAME.search(first) or Path(first).is_dir():
        bag = shlex.quote(first)
        hint = f"ingest it with `ingest bag {bag}`, or draft a manifest with `ingest init {bag}`"
        raise _usage_error(f"{first} is a recording, not a manifest", hint)
    if "/" in first or Path(first).exists():
        return ["run", *words]
    close = get_close_matches(first, NAMES, n=1)
    raise _usage_error(
        f"{first!r} is neither a command nor a manifest",
        f"did you mean `ingest {close[0]}`?" if close else "see `ingest --help`",
    )


def _usage_error(problem: str, hint: str) -> SystemExit:
    """Print the problem, and return the exception that exits with the code for wrong usage."""
    typer.echo(f"error: {one_line(problem)} — {one_line(hint)}", err=True)
    return SystemExit(2)


def _print_error(error: IngestError) -> None:
    from mosaico_ingest.cli.console import print_error

    print_error(str(error), error.findings)


def _distros(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.job.values import Stores

    return (each.value for each in Stores if each.value.startswith("ros"))


def _sequences(store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.destinations.store import Store

    return Store.open(store, create=False).names()


def _topics(store: str, incomplete: str) -> Iterable[str]:
    """Return the sequences, followed by a slash, or the topics of the sequence before the slash."""
    from mosaico_ingest.destinations.store import Store

    opened = Store.open(store, create=False)
    sequence, slash, _ = incomplete.partition("/")
    if not slash:
        return (f"{name}/" for name in opened.names())
    return (f"{sequence}{topic.name}" for topic in opened.sequence(sequence).topics)


def _adapters(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.adapters.builtin import BY_NAME

    return BY_NAME


def _tags(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.ontology.registry import tags

    return tags()


def _rules(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.rules import RULES

    return (*RULES, "all")


_SOURCES: dict[str, Callable[[str, str], Iterable[str]]] = {
    "DISTRO": _distros,
    "SEQUENCE": _sequences,
    "JOB.yaml|SEQUENCE": _sequences,
    "SEQUENCE/TOPIC": _topics,
    "SEQUENCE[/TOPIC]": _topics,
    "NAME|FILE": _adapters,
    "NAME|TYPE|FILE": _adapters,
    "TAG": _tags,
    "RULE": _rules,
}
"""The proposals by metavar; the arguments are the store and the incomplete word."""


if __name__ == "__main__":
    main()
