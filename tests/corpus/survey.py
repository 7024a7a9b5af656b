"""Ingest every data set of the corpus and print the result of each.

python tests/corpus/survey.py [--out table.tsv] [--corpus FOLDER] [PATTERN …]
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from mosaico_ingest.api import run
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.report.events import TopicStatus
from mosaico_ingest.report.recording import Report, TopicReport

CORPUS = Path(__file__).resolve().parents[3] / "shared" / "corpus"
UNMODELED = "Unmodeled"


@dataclass(frozen=True, slots=True)
class Row:
    """What became of one data set."""

    path: str
    outcome: str
    """`whole`, `part` or `refused`."""
    why: str
    wrong: str
    """Where the account does not add up; empty is right."""
    known_messages: int | None
    """What the corpus's index counts."""
    read: int
    written: int
    rejected: int
    typed: int
    unmodeled: int
    excluded: int
    empty: int
    seconds: float


def survey(corpus: Path, patterns: Sequence[str] = ()) -> Iterator[Row]:
    """Ingest every data set whose path a pattern selects (none: all), each into a store of its own."""
    with (corpus / "INDEX.tsv").open(encoding="utf-8", newline="") as file:
        entries = list(csv.DictReader(file, delimiter="\t"))
    for entry in entries:
        path = entry["path"]
        if not patterns or any(fnmatch.fnmatch(path, pattern) for pattern in patterns):
            known = int(entry["messages"]) if entry["messages"].isdigit() else None
            yield ingest(corpus, path, known)


def ingest(corpus: Path, path: str, known_messages: int | None) -> Row:
    """Ingest one data set; bad messages and topics cost themselves only."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            report = report_of(corpus / path, Path(folder) / "store")
        except IngestError as error:
            spent = time.perf_counter() - begin
            return Row(
                path, "refused", plain(str(error), corpus), "", known_messages, 0, 0, 0, 0, 0, 0, 0, spent
            )
    return row(path, report, known_messages, time.perf_counter() - begin, corpus)


def report_of(recording: Path, store: Path) -> Report:
    """Ingest one recording and return its report."""
    config = ROSInjectionConfig(
        file_path=recording,
        sequence_name="survey",
        store=store,
        topics_on_error=TopicLevelErrorPolicy.Ignore,
        manifest={"on_error": {"message": LoaderErrorPolicy.IGNORE}},
    )
    return run([config]).recordings[0]


def row(path: str, report: Report, known_messages: int | None, seconds: float, corpus: Path) -> Row:
    """Sum a report up."""
    reasons = [plain(reason, corpus) for reason in unique(reasons_of(report))]
    if report.error:
        outcome = "refused" if not report.totals.written else "part"
    else:
        outcome = "part" if reasons else "whole"
    counted = [topic for topic in report.topics if topic.status is TopicStatus.WRITTEN]
    return Row(
        path=path,
        outcome=outcome,
        why=" | ".join(reasons),
        wrong=" | ".join(unique(wrongs_of(report))),
        known_messages=known_messages,
        read=report.totals.read,
        written=report.totals.written,
        rejected=report.totals.rejected,
        typed=sum(topic.adapter != UNMODELED for topic in counted),
        unmodeled=sum(topic.adapter == UNMODELED for topic in counted),
        excluded=sum(topic.status is TopicStatus.EXCLUDED for topic in report.topics),
        empty=sum(topic.status is TopicStatus.EMPTY for topic in report.topics),
        seconds=seconds,
    )


def reasons_of(report: Report) -> Iterator[str]:
    """Yield why a data set is not ingested whole."""
    if report.error:
        yield report.error
    for topic in report.topics:
        if topic.status is TopicStatus.EXCLUDED:
            yield f"{topic.topic} left out: {topic.why}"
        if topic.error:
            yield f"{topic.topic}: {topic.error}"
        for rejection in topic.rejections:
            yield f"{topic.topic}: {rejection.count} by {rejection.rule}: {rejection.reason}"
    for item in report.unreadable_ranges:
        if item.count == 0:
            continue  # nothing is missing: it could be had another way
        yield f"lost {item.count if item.count is not None else '?'}: {item.reason}"


def wrongs_of(report: Report) -> Iterator[str]:
    """Yield where the numbers contradict each other."""
    for topic in report.topics:
        if topic.status is TopicStatus.EXCLUDED:
            continue
        if topic.read != topic.written + topic.filtered + topic.downsampled + topic.rejected:
            yield f"{topic.topic}: read {topic.read} is not the sum of what became of it"
        if topic.promised is not None and topic.promised != topic.read and not lost(report, topic):
            yield f"{topic.topic}: {topic.promised} promised, {topic.read} read, no item noted"


def lost(report: Report, topic: TopicReport) -> bool:
    """Say whether the report explains that messages of a topic are missing."""
    return bool(report.error) or any(item.topic in {None, topic.topic} for item in report.unreadable_ranges)


def unique(texts: Iterable[str]) -> list[str]:
    """Return the texts without repetitions, in order."""
    return list(dict.fromkeys(texts))


def plain(text: str, corpus: Path) -> str:
    """Return a text that is the same on every machine and fits a table."""
    return " ".join(text.replace(f"{corpus}/", "").split())[:400]


def main() -> int:
    """Print the table and its totals; fail where an account does not add up."""
    parser = argparse.ArgumentParser(description="Run every data set of the corpus through the whole tool.")
    parser.add_argument("patterns", nargs="*", help="globs on the path in INDEX.tsv; none: all")
    parser.add_argument("--out", type=Path, help="also write the table to this file, tab-separated")
    parser.add_argument("--corpus", type=Path, default=CORPUS)
    arguments = parser.parse_args()
    rows = list[Row]()
    for result in survey(arguments.corpus, arguments.patterns):
        rows.append(result)
        sys.stdout.write(
            f"{result.outcome:8}{result.read:8}{result.written:8}{result.rejected:6}  {result.path}\n"
        )
        for detail in filter(None, (result.why, result.wrong and f"WRONG {result.wrong}")):
            sys.stdout.write(f"{'':32}{detail}\n")
        sys.stdout.flush()
    sys.stdout.write(totals(rows))
    if arguments.out:
        with arguments.out.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, delimiter="\t", lineterminator="\n")
            names = [field.name for field in fields(Row) if field.name != "seconds"]
            writer.writerow(names)
            writer.writerows([getattr(result, name) for name in names] for result in rows)
    return 1 if any(result.wrong for result in rows) else 0


def totals(rows: Sequence[Row]) -> str:
    """Return the last lines: how many data sets and messages came through."""
    outcomes = {name: sum(row.outcome == name for row in rows) for name in ("whole", "part", "refused")}
    known = sum(row.known_messages or 0 for row in rows)
    messages, topics = (
        {name: sum(getattr(row, name) for row in rows) for name in names}
        for names in (("read", "written", "rejected"), ("typed", "unmodeled", "excluded", "empty"))
    )
    wrong, seconds = sum(bool(row.wrong) for row in rows), sum(row.seconds for row in rows)
    lines = [
        f"{len(rows)} data sets: {', '.join(f'{count} {name}' for name, count in outcomes.items())}",
        f"{known} messages known: {', '.join(f'{count} {name}' for name, count in messages.items())}",
        f"topics: {', '.join(f'{count} {name}' for name, count in topics.items())}",
        f"{wrong} accounts do not add up; {seconds:.0f} s",
    ]
    return "".join(f"{line}\n" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
