"""Totals of a run in the text format of Prometheus, for the textfile collector of its node exporter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from mosaico_ingest.findings import Severity
from mosaico_ingest.report.contract import ContractResult, Outcome
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.files import RunReport
from mosaico_ingest.report.timing import Step

_PREFIX = "mosaico_ingest"


def prometheus_text(report: RunReport) -> str:
    """Return the totals of a run as gauges; they have no label per sequence, which keeps their number small."""
    return "\n".join(_lines(report)) + "\n"


def contract_metrics(contracts: Sequence[ContractResult]) -> str:
    """Return the number of contracts and expectations by outcome as gauges."""
    return "".join(f"{line}\n" for line in _contract_lines(contracts))


def _contract_lines(contracts: Iterable[ContractResult]) -> Iterator[str]:
    """Yield the numbers of contracts and expectations; nothing without a contract."""
    outcomes: Counter[bool] = Counter()
    counts: Counter[tuple[Outcome, Severity]] = Counter()
    for contract in contracts:
        outcomes[contract.passed] += 1
        counts.update((result.outcome, result.severity) for result in contract.results)
    if not outcomes:
        return
    yield from _gauge("contracts", "Recordings of the last run by the outcome of their data contracts.")
    for outcome, passed in ((Outcome.PASSED, True), (Outcome.FAILED, False)):
        yield f'{_PREFIX}_contracts{{outcome="{outcome.value}"}} {outcomes[passed]}'
    yield from _gauge("expectations", "Expectations of the last run by outcome and severity.")
    for outcome in Outcome:
        for severity in (Severity.ERROR, Severity.WARNING):
            labels = f'outcome="{outcome.value}",severity="{severity.value}"'
            yield f"{_PREFIX}_expectations{{{labels}}} {counts[outcome, severity]}"


def _lines(report: RunReport) -> Iterator[str]:
    summary = report.summary
    yield from _gauge("recordings", "Recordings of the last run by status.")
    for status in RunStatus:
        yield f'{_PREFIX}_recordings{{status="{status.value}"}} {summary.statuses.get(status, 0)}'
    yield from _gauge("messages", "Messages of the last run by outcome.")
    for fate in ("read", "written", "filtered", "downsampled", "rejected", "unreadable"):
        yield f'{_PREFIX}_messages{{fate="{fate}"}} {getattr(summary, fate)}'
    yield from _contract_lines(one.contract for one in report.recordings if one.contract is not None)
    yield from _gauge(
        "step_seconds", "Time of the last run by step; the write step runs in parallel to the others."
    )
    for step in Step:
        yield f'{_PREFIX}_step_seconds{{step="{step.value}"}} {getattr(summary.steps, step.value):.6g}'
    ended = 0.0 if summary.ended_at is None else summary.ended_at.timestamp()
    single: tuple[tuple[str, str, float], ...] = (
        ("source_bytes", "Size of the recordings.", summary.source_bytes),
        ("stored_bytes", "Size of the stored rows.", summary.stored_bytes),
        ("working_seconds", "Time spent on recordings.", summary.duration_s),
        ("last_end_timestamp_seconds", "When the last recording ended, since the epoch.", ended),
        ("exit_code", "The exit code of the run.", summary.exit_code),
    )
    for name, what, value in single:
        yield from _gauge(name, what)
        yield f"{_PREFIX}_{name} {value:.15g}"


def _gauge(name: str, what: str) -> Iterator[str]:
    yield f"# HELP {_PREFIX}_{name} {what}"
    yield f"# TYPE {_PREFIX}_{name} gauge"
