"""This file writes findings as GitHub workflow commands, which annotate a pull request."""

from __future__ import annotations

from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.lint.engine import LintReport

__all__ = ["render"]

_COMMANDS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "notice"}
_ESCAPES = (("%", "%25"), ("\r", "%0D"), ("\n", "%0A"))


def render(report: LintReport) -> str:
    """Return a line for each finding."""
    return "".join(f"{_line(finding)}\n" for finding in report.findings)


def _line(finding: Finding) -> str:
    place = ""
    if finding.span is not None:
        span = finding.span
        ends = f",endLine={span.end_line}"
        ends += f",endColumn={span.end_column}" if span.line == span.end_line else ""
        place = f"file={_property(span.file)},line={span.line},col={span.column}{ends},"
    text = f"{finding.message} — {finding.help}" if finding.help else finding.message
    return f"::{_COMMANDS[finding.severity]} {place}title={_property(finding.rule)}::{_escaped(text)}"


def _escaped(text: str) -> str:
    for character, code in _ESCAPES:
        text = text.replace(character, code)
    return text


def _property(text: str) -> str:
    return _escaped(text).replace(":", "%3A").replace(",", "%2C")
