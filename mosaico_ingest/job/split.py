"""The section `split`, which makes several sequences of one recording, and the part that a job ingests."""

from __future__ import annotations

import re
from typing import Annotated

from msgspec import Struct
from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.expect import Duration
from mosaico_ingest.job.fields import FilePath, PathRole
from mosaico_ingest.job.section import Section, Text
from mosaico_ingest.protocol import check_sequence_name

SPLIT_KEY = "_split_"
"""Key of sequence metadata: the recording's name, the number, times and event of the part."""
PLACEHOLDERS = ("sequence", "part", "event")
"""The placeholders of `split.name`."""
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")
_WIDTH = re.compile(r"part:0?[0-9]d?")


def _check_name(template: str) -> str:
    names = _PLACEHOLDER.findall(template)
    unknown = [name for name in names if name not in PLACEHOLDERS and not _WIDTH.fullmatch(name)]
    if unknown:
        raise ValueError(
            f"unknown placeholder {{{unknown[0]}}}; the placeholders are {{sequence}}, {{part}}, {{part:03}} and {{event}}"
        )
    if not any(name.startswith(("part", "event")) for name in names):
        raise ValueError("all parts would have the same name; add {part} or {event}")
    try:
        check_sequence_name(_PLACEHOLDER.sub("x", template))
    except SinkError as error:
        raise ValueError(error.what) from error
    return template


def _check_positive(length_ns: int) -> int:
    if length_ns <= 0:
        raise ValueError("the length of a part must be longer than 0 s")
    return length_ns


class SplitSettings(Section):
    """One recording becomes several sequences: parts of equal length, or the intervals of a file."""

    by: Annotated[Duration, AfterValidator(_check_positive)] | None = Field(default=None, examples=["10 min"])
    """The length of each part. The first part starts at `bag.time.start`, or else at the start of the recording."""
    events: Annotated[Text, FilePath(PathRole.INPUT)] | None = Field(default=None, examples=["events.csv"])
    """A CSV file with the columns `start` and `end`, and optionally `name`; its other columns become metadata of the part."""
    name: Annotated[Text, AfterValidator(_check_name)] | None = Field(
        default=None, examples=["{sequence}_{part:03}", "{event}"]
    )
    """The name of each part's sequence: {sequence} is `sequence.name`, {part} the number of the part from 1 and {part:03}
    the padded number, {event} the name of the event. Defaults to {sequence}_{part:03}, with `events` to
    {sequence}_{event}."""

    @model_validator(mode="after")
    def _check_one_rule(self) -> SplitSettings:
        if (self.by is None) == (self.events is None):
            key = "events" if self.by is not None else "by"
            message = "write either by or events" if self.by is None else "by and events exclude each other"
            raise PydanticCustomError("conflicting-keys", "{message}", {"key": key, "message": message})
        return self

    def sequence_name(self, sequence: str, number: int, event: str) -> str:
        """Return the name of a part's sequence; `event` is a text that the platform accepts."""
        default = "{sequence}_{part:03}" if self.events is None else "{sequence}_{event}"

        def fill(match: re.Match[str]) -> str:
            name, _, width = match[1].partition(":")
            return f"{number:{width}}" if name == "part" else {"sequence": sequence, "event": event}[name]

        return _PLACEHOLDER.sub(fill, self.name or default)


def clean_name(text: str) -> str:
    """Return a text with `_` in place of characters that `{event}` cannot contain."""
    return _REFUSED.sub("_", text).strip("_")


class SequencePart(Struct, frozen=True):
    """The part of a recording that becomes one sequence: messages with start_ns <= selected time < end_ns."""

    recording: str
    """The name of the sequence that the complete recording would become."""
    number: int
    """The position of the part, from 1."""
    start_ns: int
    end_ns: int
    event: str | None = None
    """The name of the event, as written in the file."""
    read_from_ns: int | None = None
    """Start of the log times of the part's messages, inclusive; None if the log times are not known."""
    read_until_ns: int | None = None
    """End of the log times of the part's messages, exclusive; None if the log times are not known."""
    findings: tuple[Finding, ...] = ()
    """Findings about the split, which one of the parts reports."""

    @property
    def metadata(self) -> dict[str, object]:
        """The metadata that describes the part."""
        event = {} if self.event is None else {"event": self.event}
        return {
            "recording": self.recording,
            "part": self.number,
            **event,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
        }
