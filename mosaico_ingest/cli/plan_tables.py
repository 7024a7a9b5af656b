"""This file prints plans and their differences for people."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import normpath
from pathlib import Path

from rich.console import Console
from rich.text import Text

from mosaico_ingest.cli.console import plain_table
from mosaico_ingest.cli.tables import open_console
from mosaico_ingest.diagnostics import Severity
from mosaico_ingest.plan.document import (
    Decisions,
    DestinationState,
    Note,
    PlanDocument,
    RecordingPlan,
    Sample,
)
from mosaico_ingest.plan.drift import Difference
from mosaico_ingest.remote.path import is_url
from mosaico_ingest.report.units import bytes_text, count_text, seconds_text, time_text

__all__ = ["print_differences", "print_plan"]

_STYLES = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.INFO: "dim"}


def print_plan(document: PlanDocument, *, folder: Path) -> None:
    """Print every recording of a plan, and how many there are; `folder` is the manifest's."""
    console = open_console()
    for recording in document.recordings:
        _print_recording(recording, folder, console)
    if len(document.recordings) > 1:
        total = sum(part.size_bytes for one in document.recordings for part in one.decisions.files)
        console.print(
            f"{len(document.recordings)} recordings, {bytes_text(total)}", highlight=False, style="bold"
        )


def print_differences(found: Sequence[Difference]) -> None:
    """Print what changes, a line for each."""
    console = open_console()
    for one in found:
        style = "green" if one.before is None else "red" if one.after is None else "yellow"
        console.print(Text(str(one), style=style), soft_wrap=True)
    if not found:
        console.print("the plans are the same", style="green")


def _print_recording(recording: RecordingPlan, folder: Path, console: Console) -> None:
    decided = recording.decisions
    place = decided.destination
    if recording.destination.kind == "store":
        place = _seen_from(folder, place)
    console.print(Text(f"{decided.sequence} → {place}", style="bold"))
    console.print(_source(decided, folder), soft_wrap=True)
    samples = {sample.target: sample for sample in recording.samples}
    names = ("topic", "type", "messages", "becomes", "adapter", "because", "sample")
    table = plain_table(*names, numbers={"messages"})
    for topic in decided.topics:
        renamed = "" if topic.target == topic.topic else f" → {topic.target}"
        every = "" if topic.every == 1 else f" / {topic.every}"
        count = "?" if topic.count is None else f"{count_text(topic.count)}{every}"
        table.add_row(
            f"{topic.topic}{renamed}",
            topic.msgtype,
            count,
            topic.ontology,
            topic.adapter,
            topic.why,
            _tried(samples[topic.target]),
        )
    console.print(table)
    for sample in recording.samples:
        _print_rejections(sample, console)
    _print_notes(recording.notes, console)
    if recording.is_empty:
        console.print(Text("there is no message in the topics taken", style="red"))
    console.print(_state(recording.destination, decided, place), soft_wrap=True)


def _source(decided: Decisions, folder: Path) -> str:
    size = sum(part.size_bytes for part in decided.files)
    names = ", ".join(_seen_from(folder, part.path) for part in decided.files)
    text = f"{names}: {decided.container} by its first bytes, {bytes_text(size)}"
    if decided.start_ns is not None and decided.end_ns is not None:
        text += f", {time_text(decided.start_ns)} .. {time_text(decided.end_ns)} UTC"
        text += f" ({seconds_text((decided.end_ns - decided.start_ns) / 1e9)})"
    if decided.read_from_ns is not None or decided.read_until_ns is not None:
        text += f", read from {time_text(decided.read_from_ns)} until {time_text(decided.read_until_ns)}"
    return text


def _seen_from(folder: Path, path: str) -> str:
    return path if is_url(path) else normpath(folder / path)


def _tried(sample: Sample) -> Text:
    if not sample.read:
        return Text("none", style="dim")
    if sample.rejected:
        return Text(f"{sample.rejected} of {sample.read} rejected", style="red")
    return Text(f"{sample.read} fit", style="green")


def _print_rejections(sample: Sample, console: Console) -> None:
    for lost in sample.rejections:
        line = (
            f"{sample.target}: {lost.count} of {sample.read} would be rejected [{lost.rule}]: {lost.reason}"
        )
        console.print(Text(line, style="red"), soft_wrap=True)


def _print_notes(notes: Sequence[Note], console: Console) -> None:
    for note in notes:
        place = f"{note.place}: " if note.place else ""
        remedy = f" — {note.help}" if note.help else ""
        line = f"{place}{note.severity.value}[{note.rule}] {note.message}{remedy}"
        console.print(Text(line, style=_STYLES[note.severity]), soft_wrap=True)


def _state(state: DestinationState, decided: Decisions, place: str) -> Text:
    """Say what the destination said."""
    name = f"{state.kind} {place}"
    if state.problem is not None:
        return Text(f"{name} refuses: {state.problem}", style="bold red")
    if state.exists is None:
        return Text(f"{name} was not asked; --connect does", style="dim")
    what = f"has {decided.sequence}, {decided.if_exists.value} it" if state.taken else "takes it"
    if not state.exists:
        what = "will be made"
    room = ""
    if state.free_bytes is not None:
        need = (
            "" if state.estimated_bytes is None else f", at most {bytes_text(state.estimated_bytes)} needed"
        )
        room = f" ({bytes_text(state.free_bytes)} free{need})"
    return Text(f"{name}: {what}{room}", style="green")
