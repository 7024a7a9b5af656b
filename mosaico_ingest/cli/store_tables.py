"""This file prints what the embedded store holds: tables for people, JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pyarrow as pa
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.tables import open_console, print_json
from mosaico_ingest.report.units import bytes_text, count_text, seconds_text, time_text
from mosaico_ingest.store import SequenceInfo, TopicInfo

__all__ = ["print_sequence", "print_sequences", "print_topic"]

LONGEST_VALUE = 160
"""Characters of one value before it is cut; images and clouds are long."""


def print_sequences(sequences: Sequence[SequenceInfo], *, as_json: bool) -> None:
    """Print a line for each sequence."""
    if as_json:
        print_json(json.dumps([_sequence_json(info) for info in sequences], indent=2))
        return
    if not sequences:
        open_console().print("no sequences")
        return
    table = _table("sequence", topics=True, rows=True, size=True, start=False, duration=True)
    for info in sequences:
        size = bytes_text(info.stored_bytes)
        table.add_row(
            info.name,
            str(len(info.topics)),
            count_text(info.rows),
            size,
            time_text(info.start_ns),
            _span(info),
        )
    open_console().print(table)


def print_sequence(info: SequenceInfo, *, as_json: bool) -> None:
    """Print a sequence's metadata, topics and notes."""
    if as_json:
        topics = [_topic_json(topic) for topic in info.topics]
        print_json(json.dumps({**_sequence_json(info), "topics": topics}, indent=2))
        return
    console = open_console()
    console.print(Text(info.name, style="bold"))
    for key, value in info.metadata.items():
        console.print(f"  {key}: {value}")
    table = _table("topic", ontology=False, rows=True, size=True, start=False, duration=True)
    for topic in info.topics:
        size = bytes_text(topic.stored_bytes)
        table.add_row(
            topic.name,
            topic.ontology.tag,
            count_text(topic.rows),
            size,
            time_text(topic.start_ns),
            _span(topic),
        )
    console.print(table)
    for note in info.notes:
        place = f"{note.topic}: " if note.topic else ""
        console.print(
            Text(f"{time_text(note.created_ns)} {place}{note.message}", style="yellow"), soft_wrap=True
        )


def print_topic(info: TopicInfo, reader: pa.RecordBatchReader, *, rows: int, as_json: bool) -> None:
    """Print a topic's schema, counts, time span, metadata, files and first rows."""
    first = _first_rows(reader, rows)
    if as_json:
        print_json(json.dumps({**_topic_json(info), "first_rows": first}, indent=2, default=_plain))
        return
    console = open_console()
    console.print(Text(f"{info.sequence}{info.name}", style="bold"))
    facts = f"{info.ontology.tag}, {count_text(info.rows)} rows, {bytes_text(info.stored_bytes)}"
    console.print(f"{facts}, {time_text(info.start_ns)} .. {time_text(info.end_ns)} UTC")
    for segment in info.segments:
        console.print(Text(f"  {segment.path}"), soft_wrap=True)
    console.print("schema", style="dim")
    for field in info.schema:
        console.print(
            Text(f"  {field.name}: {field.type}{'' if field.nullable else ' not null'}"), soft_wrap=True
        )
    console.print("metadata", style="dim")
    for key, value in info.metadata.items():
        console.print(Text(f"  {key}: {_short(value)}"), soft_wrap=True)
    if first:
        console.print("first rows", style="dim")
    for row in first:
        console.print(Text(f"  {_short(row)}"), soft_wrap=True)


def _first_rows(reader: pa.RecordBatchReader, rows: int) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    with reader:
        for batch in reader:
            if len(found) >= rows:
                break
            found += batch.slice(0, rows - len(found)).to_pylist()
    return found


def _table(first: str, **columns: bool) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column(first, overflow="fold")
    for name, right in columns.items():
        table.add_column(name, justify="right" if right else "left")
    return table


def _span(info: SequenceInfo | TopicInfo) -> str:
    if info.start_ns is None or info.end_ns is None:
        return "-"
    return seconds_text((info.end_ns - info.start_ns) / 1e9)


def _sequence_json(info: SequenceInfo) -> dict[str, Any]:
    return {
        "name": info.name,
        "metadata": dict(info.metadata),
        "topics": len(info.topics),
        "rows": info.rows,
        "stored_bytes": info.stored_bytes,
        "start_ns": info.start_ns,
        "end_ns": info.end_ns,
        "notes": [{"topic": note.topic, "message": note.message} for note in info.notes],
    }


def _topic_json(info: TopicInfo) -> dict[str, Any]:
    return {
        "sequence": info.sequence,
        "name": info.name,
        "ontology": info.ontology.tag,
        "rows": info.rows,
        "stored_bytes": info.stored_bytes,
        "start_ns": info.start_ns,
        "end_ns": info.end_ns,
        "checksum": info.checksum,
        "metadata": dict(info.metadata),
        "files": [str(segment.path) for segment in info.segments],
        "schema": {field.name: str(field.type) for field in info.schema},
    }


def _short(value: object) -> str:
    text = (
        _cut(value)
        if not isinstance(value, dict)
        else f"{{{', '.join(f'{k}: {_cut(v)}' for k, v in value.items())}}}"
    )
    return text.replace("\n", "\\n")


def _cut(value: object) -> str:
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    text = str(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}… ({len(text)} characters)"


def _plain(value: object) -> object:
    """Say what a value that JSON has no form for is."""
    return f"<{len(value)} bytes>" if isinstance(value, bytes) else str(value)
