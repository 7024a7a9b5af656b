"""The results of expectations of the rows of a topic: headers and the values of expressions."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import TYPE_CHECKING, Any

from mosaico_ingest.contracts import (
    Clause,
    bounds_text,
    duration_text,
    extremes_text,
    limit_text,
    number_text,
    occurrence,
    part_text,
    value_text,
)
from mosaico_ingest.contracts.values import (
    AllowedValues,
    Changes,
    FiniteNumbers,
    LatencyRange,
    Moments,
    Nulls,
    NumberLimits,
    Unchanged,
    Violation,
    Violations,
)
from mosaico_ingest.display import count_text, counted
from mosaico_ingest.job.values import Limit
from mosaico_ingest.report.parts import ExpectationResult, Occurrence

if TYPE_CHECKING:
    from mosaico_ingest.contracts.rows import FieldCheck, RowMonitor


def header_result(clause: Clause, monitors: Sequence[RowMonitor], msgtype: str) -> ExpectationResult:
    """Return the result of an expectation of the messages' headers."""
    if monitors and not any(monitor.has_header for monitor in monitors):
        return clause.skipped(f"{msgtype} has no header")
    if clause.key == "latency":
        return _latency(clause, [one.latency for one in monitors if one.latency is not None])
    if clause.key == "stamps":
        return _stamps(clause, monitors)
    if clause.key == "frame_id":
        return _frames(clause, monitors)
    return _header_numbers(clause, monitors)


def field_result(clause: Clause, monitors: Sequence[RowMonitor]) -> ExpectationResult:
    """Return the result of an expectation of the values of an expression."""
    checks = [check for monitor in monitors for check in monitor.checks if check.clause.path == clause.path]
    if not checks:
        return clause.skipped("the messages are not decoded")
    accumulators = [check.accumulator for check in checks]
    if not sum(accumulator.count for accumulator in accumulators):
        return clause.skipped("the topic has no values")
    if isinstance(accumulators[0], Moments):
        return _moments(clause, checks)
    violations = _worst([one.violations for one in accumulators if not isinstance(one, Moments)])
    total = sum(accumulator.count for accumulator in accumulators)
    subject = f"`{checks[0].expression.text}`"
    if isinstance(accumulators[0], Nulls):
        return _nulls(clause, accumulators[0].limit, violations, total, subject)
    if isinstance(accumulators[0], Unchanged):
        longest = max(one.longest_ns for one in accumulators if isinstance(one, Unchanged))
        limit = f"at most {duration_text(clause.expected.max)}"
        text = f"{subject} does not change for {duration_text(longest)}; expected {limit}"
        return _from_violations(clause, violations, text, limit=limit, measured=longest, unit="ns")
    return _values(clause, accumulators, violations, total, subject)


def _values(
    clause: Clause, accumulators: Sequence[Any], violations: Violations, total: int, subject: str
) -> ExpectationResult:
    """Return the result of an expectation of each value."""
    limit, measured, description = _description(accumulators)
    text = f"{subject}: {description}; expected {limit}"
    if violations.worst is not None:
        measured = _plain(violations.worst.value)
        text = (
            f"{subject}: {count_text(violations.count)} of {counted(total, 'value')} violate the expectation, "
            f"the worst is {value_text(violations.worst.value)}; expected {limit}"
        )
    return _from_violations(clause, violations, text, limit=limit, measured=measured)


def _description(accumulators: Sequence[Any]) -> tuple[str, Any, str]:
    """Return the limit, the measured value and its description, for values that fulfill the expectation."""
    first = accumulators[0]
    if isinstance(first, FiniteNumbers):
        return "finite numbers", None, "all values are finite"
    if isinstance(first, AllowedValues):
        return " or ".join(value_text(value) for value in first.allowed), None, "all values are allowed"
    ranges: list[NumberLimits | Changes] = list(accumulators)
    lows = [one.lowest for one in ranges if one.lowest is not None]
    highs = [one.highest for one in ranges if one.highest is not None]
    low = None if first.low == -inf else number_text(first.low)
    high = None if first.high == inf else number_text(first.high)
    limit = bounds_text(low, high)
    if not lows or not highs:
        return limit, None, "there is no number"
    text = f"from {number_text(min(lows))} to {number_text(max(highs))}"
    if isinstance(first, Changes):
        text = f"changes {text} between messages"
    return limit, _plain(max(highs) if low is None else min(lows)), text


def _nulls(
    clause: Clause, limit: Limit, violations: Violations, total: int, subject: str
) -> ExpectationResult:
    part = part_text(limit, violations.count, total, "values are null")
    return _from_limit(
        clause, limit, violations.count, total, violations, text=f"{subject}: {part}", unit="values"
    )


def _moments(clause: Clause, checks: Sequence[FieldCheck]) -> ExpectationResult:
    moments = [check.accumulator for check in checks if isinstance(check.accumulator, Moments)]
    one = max(moments, key=lambda moment: moment.count)
    measured = one.mean if clause.key == "mean" else one.std
    expected = clause.expected
    bounds = (None if bound is None else number_text(bound) for bound in (expected.min, expected.max))
    limit = bounds_text(*bounds)
    name = "mean" if clause.key == "mean" else "standard deviation"
    if measured is None:
        return clause.skipped("the topic has no finite values")
    text = f"`{checks[0].expression.text}`: the {name} is {number_text(measured)}; expected {limit}"
    is_good = (expected.min is None or measured >= expected.min) and (
        expected.max is None or measured <= expected.max
    )
    details: dict[str, Any] = {"measured": measured, "limit": limit}
    return clause.passed(text, **details) if is_good else clause.failed(text, **details)


def _latency(clause: Clause, ranges: Sequence[LatencyRange]) -> ExpectationResult:
    count, unset = sum(one.count for one in ranges), sum(one.unset for one in ranges)
    if not count:
        return clause.skipped("the topic has no message that can be decoded")
    expected = clause.expected
    limit = bounds_text(
        *(None if bound is None else duration_text(bound) for bound in (expected.min, expected.max))
    )
    violations = _worst([one.violations for one in ranges])
    lowest = min((one.lowest for one in ranges if one.lowest), key=_number, default=None)
    highest = max((one.highest for one in ranges if one.highest), key=_number, default=None)
    if lowest is None or highest is None:
        text = f"the stamps of all {counted(count, 'message')} are zero, so there is no latency; expected {limit}"
        return _from_violations(clause, violations, text, limit=limit, measured=None, unit="ns")
    text = f"the latency is from {duration_text(_number(lowest))} to {duration_text(_number(highest))}; expected {limit}"
    if unset:
        text += f", and the stamps of {counted(unset, 'message')} are zero"
    too_low = expected.min is not None and _number(lowest) < expected.min
    measured = _number(lowest if too_low or expected.max is None else highest)
    return _from_violations(clause, violations, text, limit=limit, measured=measured, unit="ns")


def _stamps(clause: Clause, monitors: Sequence[RowMonitor]) -> ExpectationResult:
    steps = [step for monitor in monitors for step in monitor.steps.items()]
    if not sum(step.count for _, step in steps):
        return clause.skipped("the topic has no message that can be decoded")
    violations = {name: _worst([step.violations for key, step in steps if key == name]) for name, _ in steps}
    limit = " and ".join(violations)
    problems: list[str] = []
    if (back := violations.get("monotonic")) and back.count and back.worst is not None:
        size = duration_text(-_number(back.worst))
        problems.append(f"{counted(back.count, 'stamp')} are earlier than the one before, by up to {size}")
    if (same := violations.get("unique")) and same.count:
        problems.append(f"{counted(same.count, 'stamp')} are equal to the one before")
    if not problems:
        return clause.passed(f"all stamps are {limit}", limit=limit, measured=0, unit="messages")
    both = _worst(list(violations.values()))
    return _from_violations(
        clause,
        both,
        f"{' and '.join(problems)}; expected {limit} stamps",
        limit=limit,
        measured=both.count,
        unit="messages",
    )


def _frames(clause: Clause, monitors: Sequence[RowMonitor]) -> ExpectationResult:
    frames = [monitor.frames for monitor in monitors if monitor.frames is not None]
    count = sum(frame.count for frame in frames)
    if not count:
        return clause.skipped("the topic has no message that can be decoded")
    violations = _worst([frame.violations for frame in frames])
    limit = " or ".join(map(repr, clause.expected.one_of))
    if not violations.count:
        return clause.passed(f"the frame of all messages is {limit}", limit=limit)
    frame_ids = ", ".join(repr(text) for frame in frames for text in frame.seen)
    text = f"the frame of {count_text(violations.count)} of {counted(count, 'message')} is {frame_ids}; expected {limit}"
    measured = next((text for frame in frames for text in frame.seen), None)
    return _from_violations(clause, violations, text, limit=limit, measured=measured, unit="")


def _header_numbers(clause: Clause, monitors: Sequence[RowMonitor]) -> ExpectationResult:
    numbers = [monitor.numbers for monitor in monitors if monitor.numbers is not None]
    count = sum(one.count for one in numbers)
    if not count or all(one.is_zero for one in numbers):
        return clause.skipped("the messages have no sequence numbers")
    missing = sum(one.missing for one in numbers)
    limit: Limit = clause.expected.missing
    text = part_text(limit, missing, missing + count, "sequence numbers are missing")
    violations = _worst([one.violations for one in numbers])
    return _from_limit(clause, limit, missing, missing + count, violations, text=text, unit="messages")


def _from_limit(
    clause: Clause,
    limit: Limit,
    count: int,
    total: int,
    violations: Violations,
    *,
    text: str,
    unit: str,
) -> ExpectationResult:
    """Return the result of an expectation that allows some violations."""
    return _from_violations(
        clause,
        Violations() if limit.allows(count, total) else violations,
        f"{text}; expected {limit_text(limit)}",
        limit=limit_text(limit),
        measured=limit.measure(count, total),
        unit=unit if limit.share is None else "share",
    )


def _worst(violations: Sequence[Violations]) -> Violations:
    """Return the violations of several connections as one."""
    if len(violations) == 1:
        return violations[0]
    firsts = [one.first for one in violations if one.first is not None]
    worst = max((one for one in violations if one.worst), key=lambda one: one.excess, default=None)
    return Violations(
        sum(one.count for one in violations),
        min(firsts, key=lambda one: one.log_time_ns, default=None),
        None if worst is None else worst.worst,
        float("-inf") if worst is None else worst.excess,
    )


def _from_violations(
    clause: Clause,
    violations: Violations,
    text: str,
    *,
    limit: str,
    measured: Any,  # noqa: ANN401 - any value
    unit: str = "",
) -> ExpectationResult:
    if not violations.count:
        return clause.passed(text, measured=measured, unit=unit, limit=limit)
    first, worst = _occurrence(violations.first), _occurrence(violations.worst)
    return clause.failed(
        text + extremes_text(first, worst),
        measured=measured,
        unit=unit,
        limit=limit,
        violations=violations.count,
        first=first,
        worst=worst,
    )


def _occurrence(violation: Violation | None) -> Occurrence | None:
    return None if violation is None else occurrence(violation.log_time_ns, violation.index, violation.value)


def _number(violation: Violation) -> int:
    return int(violation.value or 0)


def _plain(value: Any) -> Any:  # noqa: ANN401 - a measured value
    """Return a value that JSON can represent."""
    return repr(value) if isinstance(value, float) and value - value != 0 else value
