"""YAML documents with the span of every value.

PyYAML's events are composed here instead of by `yaml.compose`, whose nodes lose the spans of aliases and whose errors end
the reading; lint must report every mistake of a file. CONTRIBUTING.md compares both, and ruamel.yaml.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TypeAlias

import msgspec
import yaml
from msgspec import Struct, field

from mosaico_ingest.findings import Edit, Finding, Severity, Span

Scalar = str | int | float | bool | None

_CONSTANTS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
}
_OLD_BOOLEANS = {"yes": "true", "on": "true", "no": "false", "off": "false"}
_INTEGER = re.compile(r"[-+]?[0-9]+")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WHOLE = re.compile(r"[-+]?(0x[0-9a-fA-F]+|0?o?[0-9]+)")
_LONGEST_NUMBER = 1000
_OCTAL = re.compile(r"[-+]?0o?[0-7]+")
_PADDED = re.compile(r"[-+]?0[0-9]+")
_OTHER_NUMBER = re.compile(
    r"[-+]?(0b[01_]+|0x[0-9a-fA-F]*_[0-9a-fA-F_]*|[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?|[0-9]+(:[0-5]?[0-9])+(\.[0-9]*)?)"
)


class Trap(Struct, frozen=True):
    """A scalar that YAML readers interpret differently."""

    rule: str
    message: str
    help: str


def resolve_plain(text: str) -> tuple[Scalar, Trap | None]:
    """Return the value of an unquoted scalar, and a trap if YAML readers interpret the scalar differently."""
    if text in _CONSTANTS:
        return _CONSTANTS[text], None
    boolean = _OLD_BOOLEANS.get(text.lower()) if text in {text.lower(), text.upper(), text.title()} else None
    if boolean is not None:
        message = f"{text} is a boolean to some YAML readers and text to others"
        return text, Trap("yaml-boolean", message, f'write {boolean}, or "{text}" for the text')
    if text[:1] not in "+-.0123456789":
        return text, None
    if len(text) > _LONGEST_NUMBER and _WHOLE.fullmatch(text):
        message = f"a number of {len(text)} characters"
        return text, Trap("yaml-number", message, f"quote it, or write at most {_LONGEST_NUMBER}")
    return _number(text)


def _number(text: str) -> tuple[Scalar, Trap | None]:
    trap = _trap(text)
    if trap is not None:
        return text, trap
    if _INTEGER.fullmatch(text):
        return int(text), None
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16), None
    return (float(text) if _FLOAT.fullmatch(text) else text), None


def _trap(text: str) -> Trap | None:
    if _OCTAL.fullmatch(text) and text.lstrip("+-") != "0":
        digits = str(int(text.replace("o", ""), 8))
        message = f"{text} is {digits} to some YAML readers (octal) and something else to others"
    elif _PADDED.fullmatch(text):
        digits = str(int(text))
        message = f"{text} is {digits} to some YAML readers and text to others"
    elif _OTHER_NUMBER.fullmatch(text):
        digits = "the digits alone"
        message = f"{text} is a number to some YAML readers and text to others"
    else:
        return None
    return Trap("yaml-number", message, f'write {digits}, or "{text}" for the text')


Key: TypeAlias = Scalar
Value: TypeAlias = "Scalar | list[Value] | dict[Key, Value]"
KeyPath: TypeAlias = tuple[Key, ...]

_INDICATORS = {
    "!": ("yaml-tag", "an unquoted ! starts a YAML tag"),
    "*": ("yaml-alias", "an unquoted * starts a YAML alias"),
    "&": ("yaml-anchor", "an unquoted & starts a YAML anchor"),
}
_NOWHERE = yaml.Mark("", 0, 0, 0, None, 0)
"""Default mark for events without a mark; PyYAML's events always have one."""
_QUOTABLE = re.compile(r"[^\s\"\\:#]*[^\s\"\\:#\],]")
"""Texts that a fix can quote without escaping."""

MAX_DEPTH = 40
"""Maximum nesting depth."""
MAX_NODES = 50_000
"""Maximum number of values, including those of aliases."""


def member(value: Value, part: Key) -> Value:
    """Return the value of a mapping's key or at a list's position.

    Raises:
        LookupError: The key or position does not exist.
    """
    if isinstance(value, dict):
        return value[part]
    if isinstance(value, list) and isinstance(part, int):
        return value[part]
    raise LookupError(part)


class LimitExceeded(Exception):  # noqa: N818 - a signal inside this package that never leaves it
    """The document exceeds a limit; `finding` has the location."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.message)
        self.finding = finding


class _Node(Struct):
    """A value, its span, and the spans of the values inside it, by relative key path."""

    value: Value
    span: Span
    inner: dict[KeyPath, Span] = field(default_factory=dict[KeyPath, Span])
    keys: dict[KeyPath, Span] = field(default_factory=dict[KeyPath, Span])
    size: int = 1

    def adopt(self, key: Key, child: _Node) -> None:
        """Add the spans of a child value."""
        self.inner[(key,)] = child.span
        self.inner.update({(key, *path): span for path, span in child.inner.items()})
        self.keys.update({(key, *path): span for path, span in child.keys.items()})
        self.size += child.size


class Composer:
    """The composer of one document; it adds mistakes to `findings` and continues."""

    def __init__(self, events: Iterator[yaml.Event], *, file: str, text: str, original: str) -> None:
        """Initialize with the events of `text`, which is `original` with some characters replaced."""
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
                        "yaml-documents", "a second document starts here", event, "write one job per file"
                    )
                    break
            elif isinstance(event, yaml.NodeEvent):
                root = self._node(event, depth=0)
        return root

    def _node(self, event: yaml.Event, *, depth: int) -> _Node:
        if depth > MAX_DEPTH:
            raise LimitExceeded(
                _finding(
                    "yaml-depth",
                    f"values nest deeper than {MAX_DEPTH} levels",
                    self._span(event),
                    "reduce the nesting",
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
            message = f"more than {MAX_NODES} values, including the values of aliases"
            raise LimitExceeded(_finding("yaml-size", message, self._span(event), "use fewer aliases"))
        return node

    def _anchor(self, name: str, node: _Node, event: yaml.Event) -> None:
        before = self._anchors.get(name)
        if before is not None:
            self._report(
                "yaml-anchor",
                f"anchor &{name} redefines the anchor in line {before.span.line}",
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
            self.findings.append(_finding(trap.rule, trap.message, span, trap.help))
        return _Node(value, span)

    def _indicator(self, written: str, span: Span) -> _Node:
        """Report an unquoted text that YAML interprets as an indicator, and return it as text."""
        rule, message = _INDICATORS.get(written[0], ("yaml-syntax", f"a text cannot start with {written[0]}"))
        if "{" in written and written[0] not in _INDICATORS:
            rule, message = "yaml-brace", "an unquoted { starts a YAML mapping here"
        fix = Edit(span, f'"{written}"') if _QUOTABLE.fullmatch(written) else None
        self.findings.append(_finding(rule, message, span, f'quote it: "{written}"', fix))
        return _Node(written, span)

    def _tag(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> str | None:
        """Report a tag; return it as written if it was probably meant as text, else None."""
        tag: str | None = event.tag
        if tag is None or tag in {"!", "tag:yaml.org,2002:str"}:
            return None
        short_tag = tag.replace("tag:yaml.org,2002:", "!!")
        span = self._span(event)
        if short_tag[:2] != "!!" and isinstance(event, yaml.ScalarEvent) and not event.value:
            self._indicator(self._original[slice(*_indices(event))], span)
            return short_tag
        self._report("yaml-tag", f"the YAML tag {short_tag} has no effect here", event, "remove the tag")
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
            finding = _finding("yaml-key", "a key must be one word or number", key.span, "quote it")
            self.findings.append(finding)
            return False
        if key.value in values:
            first = node.keys[(key.value,)]
            message = f"duplicate key {key.value!r}, first set in line {first.line}"
            self.findings.append(_finding("duplicate-key", message, key.span, "remove one of the two"))
            return False
        return True

    def _merge(self, merge: _Node, values: dict[Key, Value], node: _Node) -> None:
        """Add the keys of a `<<` that the mapping does not have itself; the first of several mappings takes precedence."""
        if isinstance(merge.value, list):
            parts = [_part(merge, position) for position in range(len(merge.value))]
        else:
            parts = [merge]
        for part in parts:
            if not isinstance(part.value, dict):
                message = "<< takes a mapping, or a list of them"
                self.findings.append(_finding("yaml-merge", message, part.span, "name an anchor: <<: *base"))
                continue
            for key, value in part.value.items():
                if key not in values:
                    node.keys[(key,)] = part.keys[(key,)]
                    node.adopt(key, _part(part, key))
                    values[key] = value

    def _report(self, rule: str, message: str, event: yaml.Event, remedy: str) -> None:
        self.findings.append(_finding(rule, message, self._span(event), remedy))

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
    """Return the value of `node` under `key` as a separate node."""
    inner = {path[1:]: span for path, span in node.inner.items() if path[0] == key and len(path) > 1}
    keys = {path[1:]: span for path, span in node.keys.items() if path[0] == key and len(path) > 1}
    return _Node(member(node.value, key), node.inner[(key,)], inner, keys, 1 + len(inner))


MAX_CHARACTERS = 1_000_000
"""Maximum length of a document; it also bounds the time for hostile input."""

_MAX_RECOVERIES = 100
# The C parser is ten times faster and accepts the same language.
_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_RESERVED = "@`%"
_TAG_ERRORS = ("scanning a tag", "parsing a tag", "scanning an alias", "scanning an anchor")
_REMEDIES = (
    (
        "mapping values are not allowed",
        "a second key starts here",
        "quote the value, or check the indentation",
    ),
    ("expected key", "this does not line up with the keys above", "keys of one mapping start in one column"),
    ("expected <block end>", "this does not line up with the lines above", "check the indentation"),
    ("unexpected end of stream", "the quote that opens here is never closed", "close it"),
    ("expected ',' or ']'", "the list [ … is not closed", "close it, and quote what contains , [ ] { }"),
    ("expected ',' or '}'", "the mapping { … is not closed", "close it, and quote what contains , [ ] { }"),
    (
        "sequence entries are not allowed",
        "a list item cannot start here",
        "put each item on a line of its own",
    ),
    (
        "unknown escape",
        "unknown escape in a double-quoted text",
        "use single quotes, or double the backslash",
    ),
)
_UNPRINTABLE = re.compile(r"[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Source(Struct, frozen=True):
    """A YAML document: its value, the span of each value and key, and its syntax findings.

    Paths are tuples of keys and list positions; `()` is the complete document.
    """

    file: str
    text: str
    value: Value
    """The value, as complete as possible, so that later checks can find further mistakes."""
    findings: tuple[Finding, ...] = ()
    spans: dict[KeyPath, Span] = msgspec.field(default_factory=dict[KeyPath, Span])
    key_spans: dict[KeyPath, Span] = msgspec.field(default_factory=dict[KeyPath, Span])
    others: dict[str, str] = msgspec.field(default_factory=dict[str, str])
    """The texts of the other files that spans refer to, by name."""

    def span(self, path: KeyPath) -> Span:
        """Return the span of the value at `path`, or of the nearest enclosing value if the document does not have it."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.spans:
                return self.spans[path[:length]]
        return Span(self.file, 1, 1, 1, 1)

    def key_span(self, path: KeyPath) -> Span:
        """Return the span of the last key of `path`, or the span of the value if it is a list item."""
        return self.key_spans.get(path) or self.span(path)

    def inner_span(self, path: KeyPath, start: int, end: int) -> Span:
        """Return the span of the characters `start:end` of the text at `path`, or of the complete text if it is folded or escaped."""
        span = self.span(path)
        line = self.line(span)
        text = line[span.column - 1 : span.end_column - 1] if span.line == span.end_line else ""
        value = text[1:-1] if text[:1] in {'"', "'"} else text
        if not value or self.at(path) != value:
            return span
        first = span.column + (len(text) - len(value)) // 2
        return Span(span.file, span.line, first + start, span.line, first + end)

    def line(self, span: Span) -> str:
        """Return the first line of a span without its line break; empty if the text has no such line."""
        text = self.text if span.file == self.file else self.others.get(span.file, "")
        lines = text.splitlines()
        return lines[span.line - 1] if 0 < span.line <= len(lines) else ""

    def at(self, path: KeyPath) -> Value:
        """Return the value at `path`, or None."""
        value = self.value
        try:
            for part in path:
                value = member(value, part)
        except LookupError:
            return None
        return value


def load_source(text: str, *, file: str) -> Source:
    """Read YAML without raising; mistakes are in the findings, and the value is as complete as possible."""
    text = text.removeprefix("\ufeff")
    if len(text) > MAX_CHARACTERS:
        message = f"the document has {len(text)} characters; {MAX_CHARACTERS} are allowed"
        return Source(file, text[:1000], None, (_finding("yaml-size", message, Span(file, 1, 1, 1, 1)),))
    unprintable = _UNPRINTABLE.search(text)
    if unprintable is not None:
        span = _span_at(text, unprintable.start(), file)
        message = f"the character U+{ord(unprintable.group()):04X} is not allowed in YAML"
        return Source(file, text, None, (_finding("yaml-character", message, span, "remove it"),))
    return _Reader(text, file).read()


class _Reader:
    """The reader of one document; it masks invalid characters and reads again until it reaches the end."""

    def __init__(self, text: str, file: str) -> None:
        self._original = text
        self._text = text
        self._file = file
        self._findings: list[Finding] = []

    def read(self) -> Source:
        """Return the document."""
        for _ in range(_MAX_RECOVERIES):
            composer = Composer(self._events(), file=self._file, text=self._text, original=self._original)
            try:
                root = composer.document()
            except LimitExceeded as limit:
                return self._failed([*composer.findings, limit.finding])
            except yaml.MarkedYAMLError as error:
                if not self._recover(error):
                    return self._failed([*composer.findings, *self._syntax(error)])
            else:
                findings = (*self._findings, *composer.findings)
                spans = {(): root.span, **root.inner}
                return Source(self._file, self._original, root.value, findings, spans, root.keys)
        return self._failed([])

    def _events(self) -> Iterator[yaml.Event]:
        yield from yaml.parse(self._text, Loader=_LOADER)  # lazily, so that the composer raises every error

    def _failed(self, findings: list[Finding]) -> Source:
        return Source(self._file, self._original, None, (*self._findings, *findings))

    def _recover(self, error: yaml.MarkedYAMLError) -> bool:
        """Mask the characters that cause the error; return False if the document cannot be read without them."""
        mark = error.problem_mark
        if mark is None:
            return False
        here = self._text[mark.index : mark.index + 1]
        if error.context_mark is not None and any(kind in (error.context or "") for kind in _TAG_ERRORS):
            return self._mask(error.context_mark.index)
        if here == "\t":
            return self._untab(mark)
        if here and here in _RESERVED:
            return self._mask(mark.index)
        return self._unbrace(mark.index)

    def _mask(self, *indices: int) -> bool:
        """Replace characters by underscores; return False if one of them is already an underscore."""
        if any(self._text[index] == "_" for index in indices):
            return False
        for index in indices:
            self._text = f"{self._text[:index]}_{self._text[index + 1 :]}"
        return True

    def _untab(self, mark: yaml.Mark) -> bool:
        tabs = len(self._text[mark.index :]) - len(self._text[mark.index :].lstrip("\t"))
        self._text = self._text[: mark.index] + " " * tabs + self._text[mark.index + tabs :]
        span = Span(self._file, mark.line + 1, mark.column + 1, mark.line + 1, mark.column + 1 + tabs)
        self._findings.append(_finding("yaml-tab", "a tab; YAML is indented with spaces", span, "use spaces"))
        return True

    def _unbrace(self, index: int) -> bool:
        """Mask the braces of `{stem}_x`, and of `${VAR}` inside `{ }`, which are meant as text."""
        if self._text[index - 1 : index + 1] == "${":
            opening, closing = index, self._text.find("}", index)
        elif self._text[index - 1 : index] == "}":
            opening, closing = self._text.rfind("{", 0, index), index - 1
        else:
            return False
        inside = self._text[opening + 1 : closing]
        return (
            0 <= opening < closing and inside.isprintable() and inside != "" and self._mask(opening, closing)
        )

    def _syntax(self, error: yaml.MarkedYAMLError) -> list[Finding]:
        if any(finding.rule == "yaml-tab" for finding in self._findings):
            return []  # the tab causes the later syntax errors
        problem = error.problem or "this is not YAML"
        message, remedy = next(
            ((text, remedy) for part, text, remedy in _REMEDIES if part in problem), (problem, None)
        )
        mark = (
            error.context_mark if "never closed" in message or "not closed" in message else error.problem_mark
        )
        index = 0 if mark is None else mark.index
        return [_finding("yaml-syntax", message, _span_at(self._original, index, self._file), remedy)]


def _finding(
    rule: str, message: str, span: Span, remedy: str | None = None, fix: Edit | None = None
) -> Finding:
    return Finding(rule, Severity.ERROR, message, span, remedy, fix)


def _span_at(text: str, index: int, file: str) -> Span:
    before = text[:index]
    line = before.count("\n") + 1
    column = index - (before.rfind("\n") + 1) + 1
    return Span(file, line, column, line, column + 1)
