"""Totals of a run in the text format of Prometheus, for the textfile collector of its node exporter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from mosaico_ingest.findings import Severity
from mosaico_ingest.report.contract import ContractResult, Outcome
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.model import RunReport
from mosaico_ingest.report.timing import Step

_PREFIX = "mosaico_ingest"


def prometheus_text(report: RunReport) -> str:
    """Return the totals of a run as gauges; they have no label per sequence, which keeps their number small."""
    return "\n".join(_lines(report)) + "\n"


def contract_metrics(contracts: Sequence[ContractResult]) -> str:
    """Return the number of contracts and expectations by outcome as gauges."""
    return "".join(f"{line}\n" for line in _contract_lines(contracts))


def _contract_lines(contracts: Sequence[ContractResult]) -> Iterator[str]:
    """Yield the numbers of contracts and expectations; nothing without a contract."""
    if not contracts:
        return
    yield from _gauge("contracts", "Recordings of the last run by the outcome of their data contracts.")
    passed = sum(contract.passed for contract in contracts)
    for outcome, count in ((Outcome.PASSED, passed), (Outcome.FAILED, len(contracts) - passed)):
        yield f'{_PREFIX}_contracts{{outcome="{outcome.value}"}} {count}'
    counts = Counter(
        (result.outcome, result.severity) for contract in contracts for result in contract.results
    )
    yield from _gauge("expectations", "Expectations of the last run by outcome and severity.")
    for outcome in Outcome:
        for severity in (Severity.ERROR, Severity.WARNING):
            labels = f'outcome="{outcome.value}",severity="{severity.value}"'
            yield f"{_PREFIX}_expectations{{{labels}}} {counts[outcome, severity]}"


def _lines(report: RunReport) -> Iterator[str]:
    states = Counter(one.status for one in report.recordings)
    yield from _gauge("recordings", "Recordings of the last run by status.")
    for state in RunStatus:
        yield f'{_PREFIX}_recordings{{status="{state.value}"}} {states[state]}'
    totals = [one.totals for one in report.recordings]
    yield from _gauge("messages", "Messages of the last run by outcome.")
    for fate in ("read", "written", "filtered", "downsampled", "rejected"):
        yield f'{_PREFIX}_messages{{fate="{fate}"}} {sum(getattr(one, fate) for one in totals)}'
    unread = sum(item.count or 0 for one in report.recordings for item in one.unreadable_ranges)
    yield f'{_PREFIX}_messages{{fate="unreadable"}} {unread}'
    yield from _contract_lines([one.contract for one in report.recordings if one.contract is not None])
    yield from _gauge(
        "step_seconds", "Time of the last run by step; the write step runs in parallel to the others."
    )
    for step in Step:
        spent = sum(getattr(one.steps, step.value) for one in report.recordings)
        yield f'{_PREFIX}_step_seconds{{step="{step.value}"}} {spent:.6g}'
    ended = max((one.started_at.timestamp() + one.duration_s for one in report.recordings), default=0)
    single: tuple[tuple[str, str, float], ...] = (
        ("source_bytes", "Size of the recordings.", sum(one.source_bytes for one in report.recordings)),
        ("stored_bytes", "Size of the stored rows.", sum(one.stored_bytes for one in totals)),
        ("working_seconds", "Time spent on recordings.", sum(one.duration_s for one in report.recordings)),
        ("last_end_timestamp_seconds", "When the last recording ended, since the epoch.", ended),
        ("exit_code", "The exit code of the run.", report.exit_code),
    )
    for name, what, value in single:
        yield from _gauge(name, what)
        yield f"{_PREFIX}_{name} {value:.15g}"


def _gauge(name: str, what: str) -> Iterator[str]:
    yield f"# HELP {_PREFIX}_{name} {what}"
    yield f"# TYPE {_PREFIX}_{name} gauge"
