"""docs/cli.md: the commands with their arguments and options, derived from the command line itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from typing import Any, TypeAlias

from typer.main import get_command

from mosaico_ingest.cli.app import command_line

_Click: TypeAlias = Any
"""A command or a parameter: a class of typer or of click, which depends on the version of typer."""
_HEAD = """<!-- generated from the command line: ./dev docs -->

# Command line

After reading this page, you know every command of `ingest` with its arguments and options.

`ingest JOB.yaml` is short for `ingest run JOB.yaml`. `--help` prints the same descriptions, and `--install-completion` adds
completion of commands, options, sequences, topics, adapters and rules to your shell. The exit codes that all commands share
have [their own page](exit-codes.md).
"""


def cli_reference() -> str:
    """Return docs/cli.md, with a section for each command."""
    root: _Click = get_command(command_line())
    sections = [_section(path, command) for path, command in _commands(root, "ingest")]
    return f"{_HEAD}\n{''.join(sections)}"


def _commands(group: _Click, path: str) -> Iterator[tuple[str, _Click]]:
    """Yield the path and the object of each command, without groups."""
    for name, command in group.commands.items():
        if command.hidden:
            continue
        if hasattr(command, "commands"):
            yield from _commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def _section(path: str, command: _Click) -> str:
    parameters = [
        each for each in command.params if not getattr(each, "hidden", False) and each.name != "help"
    ]
    arguments = [each for each in parameters if each.param_type_name == "argument"]
    options = [each for each in parameters if each.param_type_name == "option"]
    usage = " ".join([path, *(["[OPTIONS]"] if options else []), *map(_usage, arguments)])
    text = f"## {path}\n\n{_paragraphs(command.help or '')}\n\n```text\n{usage}\n```\n\n"
    if arguments:
        text += _table(
            ("argument", "meaning"), [(f"`{_metavar(each)}`", _meaning(each)) for each in arguments]
        )
    if options:
        text += _table(("option", "meaning"), [(_names(each), _meaning(each)) for each in options])
    return text


def _table(names: tuple[str, ...], rows: list[tuple[str, str]]) -> str:
    lines = [names, *rows]
    head, *body = (f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)
    return "".join((head, "|---|---|\n", *body, "\n"))


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n\s*\n", text.replace("\b", "")))


def _usage(argument: _Click) -> str:
    name = _metavar(argument)
    several = "…" if argument.nargs == -1 else ""
    return f"{name}{several}" if argument.required else f"[{name}{several}]"


def _metavar(parameter: _Click) -> str:
    """Return the name of a value, without the brackets that mark optional arguments."""
    name = str(parameter.metavar or parameter.name.upper())
    return name[1:-1] if name.startswith("[") and name.endswith("]") else name


def _names(option: _Click) -> str:
    """Return the names of an option with its value, such as `-n`, `--count N`."""
    *others, long = sorted(option.opts, key=len)
    value = "" if option.is_flag else f" {option.metavar or _choices(option) or 'VALUE'}"
    negative = [f"`{name}`" for name in option.secondary_opts]
    return ", ".join([*(f"`{name}`" for name in others), f"`{long}{value}`", *negative])


def _choices(option: _Click) -> str:
    """Return the words that an option accepts. The attribute with its type, and the class of the type, depend on the version of typer."""
    descriptor = getattr(option, "type_descriptor", None)
    kind: Any = descriptor.annotation if descriptor is not None else option.type
    words: Any = kind if isinstance(kind, type) and issubclass(kind, Enum) else getattr(kind, "choices", ())
    return "|".join(str(getattr(word, "value", word)) for word in words)


def _meaning(parameter: _Click) -> str:
    """Return the help with the default and the environment variable."""
    text = " ".join((parameter.help or "").split())
    default, show_default = parameter.default, getattr(parameter, "show_default", True)
    if isinstance(show_default, str):
        text += f" Default: {show_default}." if " " in show_default else f" Default: `{show_default}`."
    elif (
        show_default
        and not parameter.required
        and default not in (None, False, (), [], "")
        and not callable(default)
    ):
        text += f" Default: `{default.value if isinstance(default, Enum) else default}`."
    if parameter.envvar:
        text += f" Environment variable: `{parameter.envvar}`."
    return f"{text} Required." if parameter.required and parameter.param_type_name == "option" else text
