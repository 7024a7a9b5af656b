"""This file turns YAML events into plain values, and remembers where each of them stands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeAlias

import yaml

from mosaico_ingest.diagnostics import Edit, Finding, Severity, Span
from mosaico_ingest.manifest.scalars import Scalar, resolve_plain

__all__ = ["MAX_DEPTH", "MAX_NODES", "Composer", "LimitExceeded", "Path", "Value", "member"]

Key: TypeAlias = Scalar
Value: TypeAlias = "Scalar | list[Value] | dict[Key, Value]"
Path: TypeAlias = tuple[Key, ...]

_INDICATORS = {
    "!": ("yaml-tag", "an unquoted ! starts a YAML tag"),
    "*": ("yaml-alias", "an unquoted * starts a YAML alias"),
    "&": ("yaml-anchor", "an unquoted & starts a YAML anchor"),
}
_NOWHERE = yaml.Mark("", 0, 0, 0, None, 0)
"""What an event without a mark gets; PyYAML's own always have one."""
_QUOTABLE = re.compile(r"[^\s\"\\:#]*[^\s\"\\:#\],]")
"""Texts that quotes can be put around without a second look."""

MAX_DEPTH = 40
"""How deep values may nest."""
MAX_NODES = 50_000
"""How many values there may be, each alias counted with all it stands for."""


def member(value: Value, part: Key) -> Value:
    """Return what a mapping or list holds under a key or at a position.

    Raises:
        LookupError: There is nothing.
    """
    if isinstance(value, dict):
        return value[part]
    if isinstance(value, list) and isinstance(part, int):
        return value[part]
    raise LookupError(part)


class LimitExceeded(Exception):  # noqa: N818 - a signal inside this package, never seen outside
    """The document is larger than any manifest; `finding` says where."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.message)
        self.finding = finding


@dataclass(slots=True)
class _Node:
    """A value, its place, and the places of what is inside it, by path relative to it."""

    value: Value
    span: Span
    inner: dict[Path, Span] = field(default_factory=dict[Path, Span])
    keys: dict[Path, Span] = field(default_factory=dict[Path, Span])
    size: int = 1

    def adopt(self, key: Key, child: _Node) -> None:
        """Take over the places of a value inside this one."""
        self.inner[(key,)] = child.span
        self.inner.update({(key, *path): span for path, span in child.inner.items()})
        self.keys.update({(key, *path): span for path, span in child.keys.items()})
        self.size += child.size


class Composer:
    """Reads the events of one document; what is wrong goes to `findings` and the reading goes on."""

    def __init__(self, events: Iterator[yaml.Event], *, file: str, text: str, original: str) -> None:
        """`text` is what was parsed: `original` with some characters replaced by others."""
        self._events = events
        self._file = file
        self._masked = [i for i, (a, b) in enumerate(zip(text, original, strict=True)) if a != b and a == "_"]
        self._original = original
        self._anchors: dict[str, _Node] = {}
        self._nodes = 0
        self.findings: list[Finding] = []

    def document(self) -> _Node:
        """Return the root of the first document."""
        root = _Node(None, Span(self._file, 1, 1, 1, 1))
        documents = 0
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._report(
                        "yaml-documents", "a second document starts here", event, "one file, one job"
                    )
                    break
            elif isinstance(event, yaml.NodeEvent):
                root = self._node(event, depth=0)
        return root

    def _node(self, event: yaml.Event, *, depth: int) -> _Node:
        if depth > MAX_DEPTH:
            raise LimitExceeded(
                self._finding(
                    "yaml-depth",
                    f"values nest deeper than {MAX_DEPTH} levels",
                    self._span(event),
                    "flatten it",
                )
            )
        if isinstance(event, yaml.AliasEvent):
            return self._count(self._alias(event), event)
        if isinstance(event, yaml.ScalarEvent):
            node = self._scalar(event)
        elif isinstance(event, yaml.SequenceStartEvent):
            node = self._sequence(event, depth=depth)
        else:
            node = self._mapping(event, depth=depth)
        if isinstance(event, yaml.CollectionStartEvent):
            self._tag(event)
        if isinstance(event, yaml.NodeEvent) and event.anchor is not None:
            self._anchor(event.anchor, node, event)
        return self._count(node, event, size=1)

    def _count(self, node: _Node, event: yaml.Event, *, size: int | None = None) -> _Node:
        self._nodes += node.size if size is None else size
        if self._nodes > MAX_NODES:
            message = f"more than {MAX_NODES} values, aliases counted with what they stand for"
            raise LimitExceeded(self._finding("yaml-size", message, self._span(event), "use fewer aliases"))
        return node

    def _anchor(self, name: str, node: _Node, event: yaml.Event) -> None:
        before = self._anchors.get(name)
        if before is not None:
            self._report(
                "yaml-anchor",
                f"anchor &{name} hides the one of line {before.span.line}",
                event,
                "give each anchor its own name",
            )
        self._anchors[name] = node

    def _alias(self, event: yaml.AliasEvent) -> _Node:
        span = self._span(event)
        name = event.anchor or ""
        target = self._anchors.get(name)
        if target is None:
            return self._indicator(f"*{name}", span)
        return _Node(target.value, span, target.inner, target.keys, target.size)

    def _scalar(self, event: yaml.ScalarEvent) -> _Node:
        span = self._span(event)
        start, end = _indices(event)
        if any(start <= index < end for index in self._masked):
            return self._indicator(self._original[start:end], span)
        tag = self._tag(event)
        if tag is not None:
            return _Node(f"{tag} {event.value}".rstrip(), span)
        if not event.implicit[0] or event.style:
            return _Node(event.value, span)
        value, trap = resolve_plain(event.value)
        if trap is not None:
            self.findings.append(self._finding(trap.rule, trap.message, span, trap.help))
        return _Node(value, span)

    def _indicator(self, written: str, span: Span) -> _Node:
        """Report a text that YAML gives a meaning which was hardly meant, and return it as the text."""
        rule, message = _INDICATORS.get(written[0], ("yaml-syntax", f"a text cannot start with {written[0]}"))
        if "{" in written and written[0] not in _INDICATORS:
            rule, message = "yaml-brace", "an unquoted { starts a YAML mapping here"
        fix = Edit(span, f'"{written}"') if _QUOTABLE.fullmatch(written) else None
        self.findings.append(self._finding(rule, message, span, f'quote it: "{written}"', fix))
        return _Node(written, span)

    def _tag(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> str | None:
        """Report a tag and return it as written, None where there is none that matters."""
        tag: str | None = event.tag
        if tag is None or tag in {"!", "tag:yaml.org,2002:str"}:
            return None
        shown = tag.replace("tag:yaml.org,2002:", "!!")
        span = self._span(event)
        if shown[:2] != "!!" and isinstance(event, yaml.ScalarEvent) and not event.value:
            self._indicator(self._original[slice(*_indices(event))], span)
            return shown
        self._report("yaml-tag", f"the YAML tag {shown} means nothing here", event, "remove the tag")
        return None

    def _sequence(self, event: yaml.Event, *, depth: int) -> _Node:
        items: list[Value] = []
        node = _Node(items, self._span(event))
        for child_event in self._events:
            if isinstance(child_event, yaml.SequenceEndEvent):
                node.span = self._between(event, child_event)
                break
            child = self._node(child_event, depth=depth + 1)
            node.adopt(len(items), child)
            items.append(child.value)
        return node

    def _mapping(self, event: yaml.Event, *, depth: int) -> _Node:
        values: dict[Key, Value] = {}
        node = _Node(values, self._span(event))
        merges: list[_Node] = []
        for key_event in self._events:
            if isinstance(key_event, yaml.MappingEndEvent):
                node.span = self._between(event, key_event)
                break
            plain = isinstance(key_event, yaml.ScalarEvent) and not key_event.style
            key = self._node(key_event, depth=depth + 1)
            child = self._node(next(self._events), depth=depth + 1)
            if plain and key.value == "<<":
                merges.append(child)
            elif self._is_new_key(key, values, node):
                name = _as_key(key.value)
                node.keys[(name,)] = key.span
                node.adopt(name, child)
                values[name] = child.value
        for merge in merges:
            self._merge(merge, values, node)
        return node

    def _is_new_key(self, key: _Node, values: dict[Key, Value], node: _Node) -> bool:
        if isinstance(key.value, list | dict):
            finding = self._finding("yaml-key", "a key must be one word or number", key.span, "quote it")
            self.findings.append(finding)
            return False
        if key.value in values:
            first = node.keys[(key.value,)]
            message = f"duplicate key {key.value!r}, first given in line {first.line}"
            self.findings.append(self._finding("duplicate-key", message, key.span, "remove one of the two"))
            return False
        return True

    def _merge(self, merge: _Node, values: dict[Key, Value], node: _Node) -> None:
        """Take the keys of a `<<` that the mapping does not have itself; the first of several wins."""
        if isinstance(merge.value, list):
            parts = [_part(merge, position) for position in range(len(merge.value))]
        else:
            parts = [merge]
        for part in parts:
            if not isinstance(part.value, dict):
                message = "<< takes a mapping, or a list of them"
                self.findings.append(
                    self._finding("yaml-merge", message, part.span, "name an anchor: <<: *base")
                )
                continue
            for key, value in part.value.items():
                if key not in values:
                    node.keys[(key,)] = part.keys[(key,)]
                    node.adopt(key, _part(part, key))
                    values[key] = value

    def _report(self, rule: str, message: str, event: yaml.Event, remedy: str) -> None:
        self.findings.append(self._finding(rule, message, self._span(event), remedy))

    def _finding(
        self, rule: str, message: str, span: Span, remedy: str | None = None, fix: Edit | None = None
    ) -> Finding:
        return Finding(rule, Severity.ERROR, message, span, remedy, fix)

    def _span(self, event: yaml.Event) -> Span:
        return self._between(event, event)

    def _between(self, first: yaml.Event, last: yaml.Event) -> Span:
        start, end = first.start_mark or _NOWHERE, last.end_mark or _NOWHERE
        return Span(self._file, start.line + 1, start.column + 1, end.line + 1, end.column + 1)


def _indices(event: yaml.Event) -> tuple[int, int]:
    return (event.start_mark or _NOWHERE).index, (event.end_mark or _NOWHERE).index


def _as_key(value: Value) -> Key:
    return None if isinstance(value, list | dict) else value


def _part(node: _Node, key: Key) -> _Node:
    """Return what `node` holds under `key` as a node of its own."""
    inner = {path[1:]: span for path, span in node.inner.items() if path[0] == key and len(path) > 1}
    keys = {path[1:]: span for path, span in node.keys.items() if path[0] == key and len(path) > 1}
    return _Node(member(node.value, key), node.inner[(key,)], inner, keys, 1 + len(inner))
