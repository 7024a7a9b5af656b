"""Values of a job's options, and the notations of manifests: sizes, times, limits, topic globs and file names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum
from fnmatch import fnmatchcase
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Final, TypeAlias

from msgspec import Struct

from mosaico_ingest.findings import nearest
from mosaico_ingest.remote import AnyPath

DEFAULT_STORE = Path("mosaico")
DEFAULT_PORT = 6726
DEFAULT_MESSAGE_BYTES = 10_000_000
"""Default size of an upload message. Larger messages gain no throughput and may become chunks that clients cannot read."""
DEFAULT_TOPIC = "default"
"""The key of `on_error.topic` for topics that no other key matches."""
RECORDS_KEY = "_records_"
"""Key of sequence metadata: the metadata records, each with its name and a list of keys and values."""
CUSTOM_DATA_KEY = "_custom_data_"
"""Key of sequence metadata: the `custom_data` of rosbag2, as a list of keys and values."""
PROVENANCE_KEY = "mosaico_ingest"
"""The metadata key of a sequence, and of each of its sessions, for its provenance."""
ATTACHMENTS_KEY = "_attachments_"
"""The metadata key of a session in a store that lists the attachments that the session stored."""


RECORDING = "recording"
"""The word for the whole recording where a contract may also name a topic."""


LOCK_SUFFIX = ".lock.json"
"""Suffix of a lock file, in place of that of its manifest."""
_SIZE = re.compile(r"([0-9]{1,18}(?:\.[0-9]{1,18})?) ?([kKMGT]?i?B)")
_BYTES: Final = {
    "B": 1,
    **{f"{letter}B": 1000**power for power, letter in enumerate(("k", "M", "G", "T"), 1)},
    **{f"{letter}iB": 1024**power for power, letter in enumerate(("K", "M", "G", "T"), 1)},
    "KB": 1000,
    "kiB": 1024,
}
_OFFSET = re.compile(r"([+-])([0-9]{1,18}(?:\.[0-9]{1,18})?) ?(ns|us|ms|s|min|h)")
_NANOSECONDS: Final = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 1_000_000_000,
    "min": 60_000_000_000,
    "h": 3_600_000_000_000,
}
_DURATION = re.compile(r"([+-]?)([0-9]{1,18}(?:\.[0-9]{1,18})?) ?(ns|us|ms|s|min|h|d)")
_LONG_UNITS: Final = {**_NANOSECONDS, "d": 86_400_000_000_000}
_NUMBER = r"([0-9]{1,18}(?:\.[0-9]{1,18})?)"
_RATE = re.compile(_NUMBER + r" ?(mHz|Hz|kHz|/s|/min|/h)")
_HERTZ: Final = {"mHz": 1e-3, "Hz": 1.0, "kHz": 1e3, "/s": 1.0, "/min": 1 / 60, "/h": 1 / 3600}
_SHARE = re.compile(_NUMBER + r" ?%")
_PERIODS = re.compile(_NUMBER + r" ?periods?")
_INSTANT = re.compile(
    r"(\d{4}-\d\d-\d\d)(?:[Tt ](\d\d:\d\d(?::\d\d)?)(?:\.(\d{1,9}))?)? ?(Z|z|[+-]\d\d:\d\d)?"
)
_LIMIT = re.compile(r"([0-9]{1,18})|([0-9]{1,18}(?:\.[0-9]{1,18})?) ?%")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_INT64 = range(-(2**63), 2**63)
"""Range of times in a recording, in nanoseconds."""
FileNameValue: TypeAlias = "str | int | float"
_FIELD = re.compile(r"\{\{|\}\}|\{(?P<name>[^{}:]*)(?::(?P<kind>[^{}]*))?\}|(?P<stray>[{}])")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_IGNORED = "_"
"""The name of a field that matches any text and becomes no metadata."""
_DATE, _TIME = frozenset("YmdyjbB"), frozenset("HMSIpfz")


class LockFile(Struct, frozen=True):
    """The lock file of a manifest: its path, and the text that was read when the job was compiled."""

    path: str
    text: str


class SessionLevelErrorPolicy(str, Enum):
    """The action after an error that ends the run."""

    Report = "report"
    """Keep the accepted rows, attach the error to the sequence, and close the session."""
    Delete = "delete"
    """Delete the session."""


class TopicLevelErrorPolicy(str, Enum):
    """The action after an error in a topic."""

    Raise = "raise"
    """End the run; the session policy applies."""
    Ignore = "ignore"
    """Reject the message and continue the topic."""
    Finalize = "finalize"
    """Close the topic with its accepted rows and continue the other topics."""


class LoaderErrorPolicy(str, Enum):
    """The action for a message that cannot be decoded."""

    IGNORE = "ignore"
    """Count the message."""
    LOG_WARN = "log_warn"
    """Count the message and log a warning."""
    RAISE = "raise"
    """End the run."""


class IfExists(str, Enum):
    """The action if the sequence exists."""

    FAIL = "fail"
    SKIP = "skip"
    APPEND = "append"
    REPLACE = "replace"


class OnSchemaChange(str, Enum):
    """The action if a topic's definition differs from that of earlier sequences of the family."""

    FAIL = "fail"
    EVOLVE = "evolve"
    """Warn and store the topic with its new columns."""
    NEW_TOPIC = "new_topic"
    """Store the topic under another name."""


class OnFailure(str, Enum):
    """The action if an expectation of a contract fails."""

    FAIL = "fail"
    """Commit nothing."""
    WARN = "warn"
    """Commit, and report the failure."""
    DIVERT = "divert"
    """Commit under the name `<name>__failed`."""


class StampSource(str, Enum):
    """The time of a message that becomes `timestamp_ns` of its row."""

    LOG = "log"
    """The time at which the recorder received the message."""
    PUBLISH = "publish"
    """The time at which the publisher sent the message, which only MCAP files contain; in other files the log time."""
    HEADER = "header"
    """The stamp of the message's header; the log time if the type has no header or the stamp is zero."""


class Unmodeled(str, Enum):
    """The action for a topic whose type has no adapter."""

    KEEP = "keep"
    """Store the topic in its ROS shape."""
    SKIP = "skip"
    FAIL = "fail"


class Stores(str, Enum):
    """The distros with known standard message definitions; the values are those of rosbags."""

    EMPTY = "empty"
    LATEST = "latest"
    ROS1_NOETIC = "ros1_noetic"
    ROS2_DASHING = "ros2_dashing"
    ROS2_ELOQUENT = "ros2_eloquent"
    ROS2_FOXY = "ros2_foxy"
    ROS2_GALACTIC = "ros2_galactic"
    ROS2_HUMBLE = "ros2_humble"
    ROS2_IRON = "ros2_iron"
    ROS2_JAZZY = "ros2_jazzy"
    ROS2_KILTED = "ros2_kilted"
    ROS2_LYRICAL = "ros2_lyrical"


class TimeBound(Struct, frozen=True):
    """An instant in ns since the epoch, or an offset in ns from the first message (from the last message if negative)."""

    ns: int
    relative: bool = False

    def at(self, start_ns: int, end_ns: int) -> int:
        """Return the bound in ns since the epoch, for a recording with this first and last log time."""
        if not self.relative:
            return self.ns
        return (end_ns if self.ns < 0 else start_ns) + self.ns


class Limit(Struct, frozen=True):
    """A maximum number of messages, or their maximum share from 0 to 1; the other attribute is None."""

    count: int | None = None
    share: float | None = None

    def measure(self, count: int, total: int) -> float:
        """Return what the limit applies to: the number, or its share of a total (0 if the total is 0)."""
        return count if self.count is not None else (count / total if total else 0.0)

    def allows(self, count: int, total: int) -> bool:
        """Return whether a number, as part of a total, is within the limit."""
        return count <= (self.count if self.count is not None else (self.share or 0) * total)


class Interval(Struct, frozen=True):
    """A length of time: nanoseconds, or a multiple of a topic's period; the other attribute is None."""

    ns: int | None = None
    periods: float | None = None

    def __str__(self) -> str:
        """Return the length in the notation of manifests."""
        return f"{self.periods:g} periods" if self.ns is None else f"{self.ns} ns"


class Compression(str, Enum):
    """The trade-off between the size of a stored sequence and the time to compress it."""

    FAST = "fast"
    """Encodings by type and the lowest level of zstd."""
    SMALL = "small"
    """For each column the smallest encoding of a sample, and a higher level of zstd."""


class StoreTarget(Struct, frozen=True):
    """The embedded store in a directory, or behind a URL."""

    kind: ClassVar[str] = "store"
    path: AnyPath
    compression: Compression = Compression.FAST


@dataclass(frozen=True, slots=True)
class ServerTarget:
    """A Mosaico server."""

    kind: ClassVar[str] = "server"
    host: str
    port: int
    api_key: str | None = field(default=None, repr=False)
    tls_cert: Path | None = None
    tls: bool = False
    message_bytes: int = DEFAULT_MESSAGE_BYTES
    """Maximum size, in bytes, up to which rows are combined into one upload message."""


class PluginTarget(Struct, frozen=True):
    """A destination that an installed package provides; see `mosaico_ingest.destinations`."""

    kind: str
    """The name of its entry point."""
    options: Mapping[str, Any] = {}
    base_dir: Path = Path()
    """The folder where the relative paths of `options` start."""


Target: TypeAlias = StoreTarget | ServerTarget | PluginTarget


def parse_size(text: str) -> int:
    """Parse a size such as `512MiB`, `2 GB` or `100kB`; return bytes.

    Raises:
        ValueError: The text is not a size.
    """
    match = _SIZE.fullmatch(text)
    if match is None or match[2] not in _BYTES:
        raise ValueError(f"{text!r} is not a size; write a number and a unit, such as 512MiB or 2GB")
    return int(float(match[1]) * _BYTES[match[2]])


def parse_limit(text: str) -> Limit:
    """Parse a limit: a number (`100`) or a share (`0.1%`).

    Raises:
        ValueError: The text is neither a number nor a share, or the share is more than 100%.
    """
    match = _LIMIT.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{text!r} is not a limit; write a number of messages, such as 100, or a share, such as 0.1%"
        )
    if match[1]:
        return Limit(count=int(match[1]))
    share = float(match[2]) / 100
    if share > 1:
        raise ValueError(f"{text!r} is out of range; write a share from 0% to 100%")
    return Limit(share=share)


def parse_time(text: str) -> TimeBound:
    """Parse an instant (`2026-03-01T12:00:00Z`) or an offset (`+10s`, `-5min`).

    Raises:
        ValueError: The text is neither an instant nor an offset.
    """
    if text[:1] in {"+", "-"}:
        return TimeBound(parse_offset(text), relative=True)
    return TimeBound(parse_instant(text))


def format_time(bound: TimeBound) -> str:
    """Format a bound in the notation of manifests."""
    if bound.relative:
        seconds, rest = divmod(abs(bound.ns), 1_000_000_000)
        fraction = f".{rest:09}".rstrip("0") if rest else ""
        return f"{'-' if bound.ns < 0 else '+'}{seconds}{fraction}s"
    seconds, rest = divmod(bound.ns, 1_000_000_000)
    moment = datetime.fromtimestamp(seconds, tz=timezone.utc)
    fraction = f".{rest:09}".rstrip("0") if rest else ""
    return f"{moment:%Y-%m-%dT%H:%M:%S}{fraction}Z"


def parse_offset(text: str) -> int:
    """Parse an offset such as `+10s` or `-1.5min` in ns, us, ms, s, min or h; return nanoseconds.

    Raises:
        ValueError: The text is not an offset, or the offset exceeds 292 years.
    """
    match = _OFFSET.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{text!r} is not an offset; write a sign, a number and a unit, such as +10s or -1.5min"
        )
    whole, _, fraction = match[2].partition(".")
    unit = _NANOSECONDS[match[3]]
    magnitude = int(whole) * unit + (int(fraction) * unit // 10 ** len(fraction) if fraction else 0)
    if magnitude not in _INT64:
        raise ValueError(f"{text!r} is out of range; write an offset of at most 292 years (2562047h)")
    return -magnitude if match[1] == "-" else magnitude


def parse_duration(text: str, *, signed: bool = False) -> int:
    """Parse a duration such as `50 ms`, `1.5h` or `2 d`, with `signed` also `-5 ms`; return nanoseconds.

    Raises:
        ValueError: The text is not a duration, or the duration exceeds 292 years.
    """
    match = _DURATION.fullmatch(text)
    if match is None or (match[1] and not signed):
        raise ValueError(f"{text!r} is not a duration; write a number and a unit, such as 50 ms, 30s or 2h")
    whole, _, fraction = match[2].partition(".")
    unit = _LONG_UNITS[match[3]]
    length = int(whole) * unit + (int(fraction) * unit // 10 ** len(fraction) if fraction else 0)
    if length not in _INT64:
        raise ValueError(f"{text!r} is out of range; write a duration of at most 292 years (2562047h)")
    return -length if match[1] == "-" else length


def format_duration(ns: int) -> str:
    """Format a duration in the largest unit that represents it exactly, such as `50 ms`."""
    unit = next((unit for unit in ("h", "min", "s", "ms", "us") if ns and ns % _NANOSECONDS[unit] == 0), "ns")
    return f"{ns // _NANOSECONDS[unit]} {unit}"


def parse_rate(text: str) -> float:
    """Parse a rate such as `95 Hz`, `2 kHz` or `10/min`; return hertz.

    Raises:
        ValueError: The text is not a rate.
    """
    match = _RATE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a rate; write a number and a unit, such as 95 Hz or 10/min")
    return float(match[1]) * _HERTZ[match[2]]


def parse_share(text: str) -> float:
    """Parse a share such as `5%`; return a number from 0 to 1.

    Raises:
        ValueError: The text is not a share, or is more than 100%.
    """
    match = _SHARE.fullmatch(text)
    if match is None or float(match[1]) > 100:  # noqa: PLR2004 - percent
        raise ValueError(f"{text!r} is not a share; write a number from 0% to 100%, such as 5%")
    return float(match[1]) / 100


def parse_interval(text: str) -> Interval:
    """Parse a duration (`100 ms`) or a multiple of a topic's period (`2 periods`).

    Raises:
        ValueError: The text is neither of the two.
    """
    match = _PERIODS.fullmatch(text)
    if match is not None:
        return Interval(periods=float(match[1]))
    try:
        return Interval(ns=parse_duration(text))
    except ValueError:
        message = f"{text!r} is neither a duration nor a number of periods; write 100 ms or 2 periods"
        raise ValueError(message) from None


def parse_instant(text: str) -> int:
    """Parse an ISO 8601 date, or date and time (UTC by default); return nanoseconds since the epoch.

    Raises:
        ValueError: The text is not an instant, or is not between 1678 and 2262.
    """
    match = _INSTANT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is neither an instant (2026-03-01T12:00:00Z) nor an offset (+10s, -5min)")
    zone = "+00:00" if match[4] in {None, "Z", "z"} else match[4]
    moment = datetime.fromisoformat(f"{match[1]}T{match[2] or '00:00'}{zone}")
    since = moment - _EPOCH
    seconds = since.days * 86_400 + since.seconds
    instant = seconds * 1_000_000_000 + int((match[3] or "0").ljust(9, "0"))
    if instant not in _INT64:
        raise ValueError(f"{text!r} is out of range; write an instant between the years 1678 and 2262")
    return instant


class Selection(Struct, frozen=True):
    """The selected topics, and for each topic the position of the deciding pattern (None: the default)."""

    selected: tuple[str, ...]
    decided_by: dict[str, int | None]
    unused: tuple[int, ...]
    """Positions of the patterns that matched no topic."""


def select(patterns: Sequence[str], topics: Iterable[str]) -> Selection:
    """Apply `patterns` in order: a plain one selects the topics it matches, one with a leading `!` excludes them.

    A pattern matches the complete name and is case-sensitive; `*` also matches `/`. If every pattern excludes, all other
    topics are selected.
    """
    names = tuple(topics)
    default = all(pattern.startswith("!") for pattern in patterns)
    is_selected = dict.fromkeys(names, default)
    decided: dict[str, int | None] = dict.fromkeys(names)
    unused: list[int] = []
    for position, pattern in enumerate(patterns):
        glob = pattern.removeprefix("!")
        matched = [name for name in names if fnmatchcase(name, glob)]
        for name in matched:
            is_selected[name] = not pattern.startswith("!")
            decided[name] = position
        if not matched:
            unused.append(position)
    return Selection(tuple(name for name in names if is_selected[name]), decided, tuple(unused))


def first_match(patterns: Iterable[str], topic: str) -> str | None:
    """Return the pattern that applies to `topic`: its exact name before any glob, then the first glob listed."""
    globs = list(patterns)
    if topic in globs:
        return topic
    return next((glob for glob in globs if fnmatchcase(topic, glob)), None)


def is_glob(pattern: str) -> bool:
    """Return whether a pattern can match several names."""
    return any(character in pattern for character in "*?[")


_KINDS: Mapping[str, tuple[str, Callable[[str], FileNameValue]]] = {
    "text": (r"[^/]+?", str),
    "int": (r"[0-9]+", int),
    "float": (r"[0-9]+(?:\.[0-9]+)?", float),
}
"""The regular expression and the conversion of each kind of field."""
_DIRECTIVES = {
    "Y": "[0-9]{4}", "m": "[0-9]{2}", "d": "[0-9]{2}", "H": "[0-9]{2}", "M": "[0-9]{2}", "S": "[0-9]{2}",
    "y": "[0-9]{2}", "j": "[0-9]{3}", "I": "[0-9]{2}", "p": "[AaPp][Mm]", "b": "[A-Za-z]{3}", "B": "[A-Za-z]{3,9}",
    "f": "[0-9]{1,6}", "z": "(?:[+-][0-9]{2}:?[0-9]{2}|Z)", "%": "%",
}  # fmt: skip
"""The regular expression of each date directive."""


class FileNamePattern:
    """A pattern of file names whose fields become metadata.

    `{name}` matches text, `{name:int}` and `{name:float}` match numbers, `{name:%Y%m%d}` matches a date, and `{_}` matches
    text that is ignored. A pattern with `/` also matches the names of the folders.
    """

    def __init__(self, text: str) -> None:
        """Parse a pattern.

        Raises:
            ValueError: A field has no valid name or kind, or occurs twice.
        """
        self.text = text
        self._conversions: dict[str, Callable[[str], FileNameValue]] = {}
        parts: list[str] = []
        position = 0
        for match in _FIELD.finditer(text):
            parts += [re.escape(text[position : match.start()]), self._field(match)]
            position = match.end()
        self._expression = "".join((*parts, re.escape(text[position:])))
        if not self._conversions:
            raise ValueError(f"{text!r} has no field; write a pattern such as {{vehicle}}_{{run:int}}.mcap")

    def __repr__(self) -> str:
        """Return the constructor call."""
        return f"FileNamePattern({self.text!r})"

    def __str__(self) -> str:
        """Return the pattern as written."""
        return self.text

    def __eq__(self, other: object) -> bool:
        """Compare the texts."""
        return isinstance(other, FileNamePattern) and other.text == self.text

    def __hash__(self) -> int:
        """Return the hash of the text."""
        return hash(self.text)

    def __reduce__(self) -> tuple[type[FileNamePattern], tuple[str]]:
        """Pickle the text only."""
        return FileNamePattern, (self.text,)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the fields, in their order."""
        return tuple(self._conversions)

    @property
    def depth(self) -> int:
        """The number of path components that the pattern matches: 1 for a file name."""
        return self.text.count("/") + 1

    def match(self, name: str) -> dict[str, FileNameValue] | None:
        """Return the value of each field, or None if the name does not match or has an impossible date.

        Dates become ISO texts: `2026-03-01`, `12:30:00`, or `2026-03-01T12:30:00`.
        """
        match = self._compiled.fullmatch(name)
        if match is None:
            return None
        try:
            return {field: convert(match[field]) for field, convert in self._conversions.items()}
        except ValueError:  # such as the month 13
            return None

    @cached_property
    def _compiled(self) -> re.Pattern[str]:
        return re.compile(self._expression)

    def _field(self, match: re.Match[str]) -> str:
        """Return the regular expression of a field or of an escaped brace."""
        if match[0] in {"{{", "}}"}:
            return re.escape(match[0][0])
        if match["stray"]:
            raise ValueError(f"a single {match[0]} in {self.text!r}; write {match[0] * 2} for a brace")
        name, kind = match["name"], match["kind"] or "text"
        if not _NAME.fullmatch(name):
            raise ValueError(f"{match[0]} has no valid name; use letters, digits and _")
        if name in self._conversions:
            raise ValueError(f"the field {name!r} occurs twice")
        if "%" in kind:
            expression, convert = _date_field(kind)
        elif kind in _KINDS:
            expression, convert = _KINDS[kind]
        else:
            close = nearest(kind, _KINDS)
            hint = (
                f"did you mean {close!r}?" if close else f"use {', '.join(_KINDS)}, or a date such as %Y%m%d"
            )
            raise ValueError(f"{match[0]} has the unknown kind {kind!r}; {hint}")
        if name == _IGNORED:
            return f"(?:{expression})"
        self._conversions[name] = convert
        return f"(?P<{name}>{expression})"


def _date_field(template: str) -> tuple[str, Callable[[str], FileNameValue]]:
    """Return the regular expression and the conversion of a date field."""
    parts: list[str] = []
    directives: set[str] = set()
    position = 0
    for match in re.finditer("%(.?)", template):
        directive = match[1]
        if directive not in _DIRECTIVES:
            raise ValueError(
                f"%{directive} in {template!r} is not a date directive; use {', '.join(f'%{d}' for d in _DIRECTIVES)}"
            )
        directives.add(directive)
        parts += [re.escape(template[position : match.start()]), _DIRECTIVES[directive]]
        position = match.end()
    has_date, has_time = bool(directives & _DATE), bool(directives & _TIME)
    expression = "".join((*parts, re.escape(template[position:])))
    return expression, partial(_iso_text, template, has_date=has_date, has_time=has_time)


def _iso_text(template: str, text: str, *, has_date: bool, has_time: bool) -> str:
    moment = datetime.strptime(text, template)  # noqa: DTZ007 - the pattern decides whether there is a zone
    if has_date and has_time:
        return moment.isoformat()
    return moment.date().isoformat() if has_date else moment.timetz().isoformat()
