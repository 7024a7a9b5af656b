"""This file writes the first draft of an adapter: every field of a message type, guessed by equal names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import indent
from typing import Any, cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.builtin import find_builtin
from mosaico_ingest.adapters.guess import Guess, guess_columns, guess_type
from mosaico_ingest.adapters.mapping.load import MappingAdapter, MappingSpec, load_adapter
from mosaico_ingest.adapters.unread import unread_fields
from mosaico_ingest.adapters.yamltext import flow, key
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.registry import ontology_type, tags

__all__ = ["Example", "draft"]

_LONG = 1500
"""How many characters of a message a test spells out; a longer one is named by its place in the recording."""


@frozen
class Example:
    """A recorded message for the draft's test."""

    row: pa.StructArray
    """The message as the only row, in the ROS shape."""
    place: Mapping[str, Any]
    """Where it is: bag, topic, index."""


def draft(
    definition: Definition,
    *,
    ontology: str | None = None,
    embed: bool = False,
    example: Example | None = None,
) -> str:
    """Return an adapter file for a message type that binds to it as it is.

    Without `ontology` it defines a type of its own. `embed` puts the definition in, for a type no distro knows.

    Raises:
        AdapterError: The message type has no fields, or there is no such ontology.
    """
    shape = ros_shape(definition)
    if not definition.message.fields:
        raise AdapterError(f"{definition.root} has no fields", hint="there is nothing to adapt")
    if ontology is None:
        own, guesses = guess_type(definition)
        target = "\n".join(["ontology:", f"  tag: {_tag(definition)}", "  fields:", *own])
    else:
        guesses = guess_columns(ontology_type(ontology).struct, definition, shape)
        target = f"ontology: {ontology}"
    lines = list(_lines(guesses, "  "))
    head = [*_head(definition), target, "", _opening(lines), *lines]
    spec = load_adapter("\n".join(head) + "\n", file="<draft>", adapters=find_builtin)
    adapter = spec.bind(definition, shape)
    parts = ["\n".join([*head, *_unread(adapter, definition, shape)])]
    if embed:
        parts.append("definition: |\n" + indent(definition.text.rstrip("\n"), "  ", lambda _: True))
    parts.append("tests:\n" + "\n".join(_test(spec, adapter, definition, example)))
    return "\n\n".join(parts) + "\n"


def _tag(definition: Definition) -> str:
    """Return a tag for a type of one's own; those of the ontology are taken."""
    short = definition.root.rpartition("/")[2]
    return f"{short}Message" if short in tags() else short


def _head(definition: Definition) -> Iterator[str]:
    yield f"# A first draft for {definition.root}: what has an equal name is filled in, the rest is for you."
    constants = ", ".join(f"{one.name} = {one.value}" for one in definition.message.constants)
    if constants:
        yield f"# Constants of the message, usable by name: {constants}"
    yield "version: 1"
    yield f"adapter: {definition.root.rpartition('/')[2]}Adapter"
    yield f"ros_type: {definition.root}"


def _lines(guesses: tuple[Guess, ...], margin: str) -> Iterator[str]:
    for guess in guesses:
        note = f"  # {guess.note}" if guess.note else ""
        if guess.fields:
            of = f"of: {guess.value}" if guess.value else None
            yield f"{margin}{key(guess.name)}:{note}"
            if of:
                yield f"{margin}  {of}"
            inner = list(_lines(guess.fields, margin + "    "))
            yield f"{margin}  {_opening(inner)}"
            yield from inner
        elif guess.value is None:
            yield f"{margin}# {key(guess.name)}:{note}"
        else:
            yield f"{margin}{key(guess.name)}: {guess.value}{note}"


def _opening(lines: list[str]) -> str:
    """Return what stands before fields: YAML needs an empty mapping where all of them are comments."""
    return "fields: {}" if all(line.lstrip().startswith("#") for line in lines) else "fields:"


def _unread(adapter: MappingAdapter, definition: Definition, shape: pa.StructType) -> Iterator[str]:
    names = unread_fields(adapter, shape)
    if names:
        yield f"  # Not used yet, of {definition.root}: {', '.join(names)}"


def _test(
    spec: MappingSpec, adapter: MappingAdapter, definition: Definition, example: Example | None
) -> Iterator[str]:
    if example is None:
        yield "  - name: nothing but zeros"
        yield "    given: {}"
        yield "    expect: {}"
        return
    adapted = adapter.adapt(example.row, Envelope("", definition.root, np.zeros(1, np.int64)))
    given = flow(_said(cast("Any", example.row)[0].as_py()))
    yield f"  - name: a message of {example.place['topic']}"
    yield f"    given: {given if len(given) <= _LONG else flow(example.place)}"
    if adapted.failures:
        yield f"    # {spec.name} rejects it: {adapted.failures[0].reason}"
        yield f"    rejects: {flow(adapted.failures[0].reason)}"
        return
    expected = {name: flow(value) for name, value in _known(cast("Any", adapted.rows)[0].as_py()).items()}
    short = {name: text for name, text in expected.items() if len(text) <= _LONG}
    yield "    expect:" if short else "    expect: {}"
    for name, text in short.items():
        yield f"      {key(name)}: {text}"


def _said(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message without what a test need not give: zeros, empty texts and lists."""
    kept = {
        name: _said(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in message.items()
    }
    return {
        name: value for name, value in kept.items() if value is not None and value not in (0, "", b"", [], {})
    }


def _known(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its nulls."""
    kept = {
        name: _known(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in record.items()
    }
    return {name: value for name, value in kept.items() if value is not None and value != {}}
