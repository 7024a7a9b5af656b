"""The help texts are complete, and options have the same meaning in all commands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from mosaico_ingest.cli.app import GROUP_HELP, command_line


def _commands(command: Any, name: str = "ingest") -> Iterator[tuple[str, Any]]:
    yield name, command
    for inner in getattr(command, "commands", {}).values():
        yield from _commands(inner, f"{name} {inner.name}")


COMMANDS = dict(_commands(get_command(command_line())))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_texts_contain_no_markup_brackets(name: str) -> None:
    for parameter in COMMANDS[name].params:
        assert "[" not in (getattr(parameter, "help", None) or ""), parameter.name


def test_help_of_groups_is_the_same_without_their_commands() -> None:
    commands = get_command(command_line()).commands
    assert {name: commands[name].help for name in GROUP_HELP} == GROUP_HELP


def test_short_options_have_one_meaning() -> None:
    meaning: dict[str, str] = {}
    for name, command in COMMANDS.items():
        for parameter in command.params:
            for short in (o for o in parameter.opts if o[0] == "-" and o[1] != "-"):
                long = next(o for o in parameter.opts if o.startswith("--"))
                if short in {"-n", "-m"} and name.startswith(("ingest store ", "ingest adapters try")):
                    continue  # -n is a number of rows or messages, as in head and tail; `ingest bag -n` is the official --name
                assert meaning.setdefault(short, long) == long, name


@pytest.mark.parametrize(("command", "said"), [("init", "(stdout)"), ("bag", "(mosaico)")])
def test_help_states_defaults(command: str, said: str) -> None:
    assert said in CliRunner().invoke(command_line(), [command, "--help"], env={"COLUMNS": "150"}).output


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_no_python_types(name: str) -> None:
    arguments = [*name.split()[1:], "--help"]
    output = CliRunner().invoke(command_line(), arguments, env={"COLUMNS": "150"}).output
    assert not re.search(r"<(bool|str|int|float|path|dir|file|list)|\b(INTEGER|FLOAT|PATH)\b", output), output
