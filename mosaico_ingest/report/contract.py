"""The results of a data contract, as the report, the metadata of a sequence and CI formats contain them."""

from __future__ import annotations

from enum import Enum
from typing import Literal

from pydantic import ConfigDict, computed_field

from mosaico_ingest.documents import Part
from mosaico_ingest.findings import Finding, Severity, Span


class ReportPart(Part):
    """The base of the parts of a report."""

    # Computed fields are written for other programs and ignored when a report is read.
    model_config = ConfigDict(extra="ignore", defer_build=True)


class Outcome(str, Enum):
    """The outcome of one expectation."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The expectation was not evaluated; `text` has the reason."""


class Location(ReportPart):
    """The location of an expectation in a manifest; lines and columns start at 1, and the end column is exclusive."""

    file: str
    line: int
    column: int
    end_line: int
    end_column: int

    @classmethod
    def of(cls, span: Span) -> Location:
        """Return a span as a part of a report."""
        return cls(
            file=span.file,
            line=span.line,
            column=span.column,
            end_line=span.end_line,
            end_column=span.end_column,
        )

    @property
    def span(self) -> Span:
        """The location as a span."""
        return Span(self.file, self.line, self.column, self.end_line, self.end_column)


class Occurrence(ReportPart):
    """One violation of an expectation."""

    log_time_ns: int | None = None
    """Log time of the message, in ns since the epoch; for an interval, of the message that ends it."""
    index: int | None = None
    """Position of the message on its topic in log-time order, from 0."""
    value: bool | int | float | str | None = None
    """The value, in the unit of the result."""


class ExpectationResult(ReportPart):
    """The result of one expectation for the recording or one of its topics."""

    expectation: str
    """The key path of the expectation, such as `expect.topics./imu.rate`."""
    severity: Severity
    """`error` or `warning`."""
    outcome: Outcome
    text: str
    """The result in one line, such as `the longest gap is 2.1 s, at most 50 ms expected`."""
    key: str = ""
    """The part of the key path below the recording or topic, such as `rate` or `fields.linear_acceleration.z.between`."""
    topic: str | None = None
    """The topic in the recording; None for an expectation of the recording or of a group."""
    location: Location | None = None
    """The location of the expectation's key; None without a manifest."""
    measured: bool | int | float | str | None = None
    """The measured value, in `unit`."""
    limit: str = ""
    """The expected value in words, such as `at most 50 ms`."""
    unit: str = ""
    """The unit of `measured` and of the occurrences: Hz, ns, messages, share, or empty."""
    violations: int = 0
    """Number of violations."""
    first: Occurrence | None = None
    """The first violation, if violations have a position."""
    worst: Occurrence | None = None
    """The violation that is farthest from the limit."""
    explained: int = 0
    """Number of violations that are not counted because events of the recorder explain them."""

    @property
    def passed(self) -> bool:
        """Whether the expectation did not fail."""
        return self.outcome is not Outcome.FAILED

    @property
    def line(self) -> str:
        """The result in one line, with its topic."""
        return f"{self.topic}: {self.text}" if self.topic else self.text

    @property
    def finding(self) -> Finding | None:
        """The result as a finding; None for an expectation that passed without explained violations."""
        text = self.line
        span = None if self.location is None else self.location.span
        if self.outcome is Outcome.FAILED:
            severity = self.severity
            return Finding("expectation-failed", severity, text, span)
        if self.outcome is Outcome.SKIPPED:
            return Finding("expectation-skipped", Severity.INFO, text, span)
        return Finding("expectation-explained", Severity.INFO, text, span) if self.explained else None


class ContractResult(ReportPart):
    """The results of all expectations of one recording."""

    on_failure: Literal["fail", "warn", "divert"]
    """The action if an expectation with the severity `error` fails."""
    results: tuple[ExpectationResult, ...] = ()
    stored_as: str | None = None
    """The name of the sequence that a recording was diverted to."""

    @computed_field
    @property
    def passed(self) -> bool:
        """Whether no expectation with the severity `error` failed."""
        return not self.errors

    @property
    def errors(self) -> tuple[ExpectationResult, ...]:
        """The failed expectations with the severity `error`."""
        return tuple(one for one in self.results if not one.passed and one.severity is Severity.ERROR)

    @property
    def warnings(self) -> tuple[ExpectationResult, ...]:
        """The failed expectations with the severity `warning`."""
        return tuple(one for one in self.results if not one.passed and one.severity is Severity.WARNING)
