"""The expectations of several recordings of one run: files, starts, ends, and the intervals between them."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase

from msgspec import Struct

from mosaico_ingest.contracts import texts
from mosaico_ingest.contracts.clauses import Clause, Contract, occurrence
from mosaico_ingest.report.contract import ExpectationResult
from mosaico_ingest.report.units import counted


class Member(Struct, frozen=True):
    """A recording of a group; the times are None if it has no message or cannot be opened."""

    names: tuple[str, ...]
    """The names of its files, and of its folder if it is one."""
    start_ns: int | None = None
    end_ns: int | None = None


def group_results(contract: Contract, members: Sequence[Member]) -> tuple[ExpectationResult, ...]:
    """Return the results of `expect.group` for the recordings of one group."""
    return tuple(_result(clause, members) for clause in contract.group_clauses())


def _result(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    if clause.key in {"starts", "ends"}:
        return _distance(clause, members)
    return _gap(clause, members) if clause.key == "gap" else _file(clause, members)


def _file(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    pattern = clause.expected
    names = [name for member in members for name in member.names]
    count = sum(any(fnmatchcase(name, pattern) for name in member.names) for member in members)
    if count:
        text = f"{pattern!r} matches {counted(count, 'recording')}"
        return clause.passed(text, measured=count, unit="recordings", limit="at least 1 recording")
    near = get_close_matches(pattern, names, n=1, cutoff=0.4)
    nearest = f"; the nearest is {near[0]}" if near else ""
    text = f"no file for {pattern!r} among {counted(len(members), 'recording')}{nearest}"
    return clause.failed(text, measured=0, unit="recordings", limit="at least 1 recording")


def _distance(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    times = [
        (time, member.names[0])
        for member in members
        if (time := member.start_ns if clause.key == "starts" else member.end_ns) is not None
    ]
    absent = [member.names[0] for member in members if member.start_ns is None]
    limit = f"at most {texts.duration(clause.expected.within)}"
    if absent:
        return clause.failed(f"{absent[0]} has no message, so it has no start and no end", limit=limit)
    if not times:
        return clause.skipped("the group has no recording")
    (first, early), (last, late) = min(times), max(times)
    distance = last - first
    verb = "starts" if clause.key == "starts" else "ends"
    text = f"{late} {verb} {texts.duration(distance)} after {early}; expected {limit}"
    if distance <= clause.expected.within:
        return clause.passed(text, measured=distance, unit="ns", limit=limit)
    return clause.failed(
        text, measured=distance, unit="ns", limit=limit, worst=occurrence(last, None, distance)
    )


def _gap(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    spans = sorted(
        (member.start_ns, member.end_ns, member.names[0])
        for member in members
        if member.start_ns is not None and member.end_ns is not None
    )
    limit = f"at most {texts.duration(clause.expected.max)}"
    if len(spans) < 2:  # noqa: PLR2004 - an interval lies between two recordings
        return clause.skipped(f"the group has {counted(len(spans), 'recording')} with messages")
    longest, before, after, end = 0, "", "", spans[0][1]
    bad = 0
    previous = spans[0][2]
    for start, stop, name in spans[1:]:
        gap = start - end
        bad += gap > clause.expected.max
        if gap > longest:
            longest, before, after = gap, previous, name
        if stop > end:
            end, previous = stop, name
    if not longest:
        return clause.passed(f"no interval is missing; expected {limit}", measured=0, unit="ns", limit=limit)
    text = f"{texts.duration(longest)} are missing between {before} and {after}; expected {limit}"
    if not bad:
        return clause.passed(text, measured=longest, unit="ns", limit=limit)
    return clause.failed(text, measured=longest, unit="ns", limit=limit, violations=bad)
