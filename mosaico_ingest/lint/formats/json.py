"""This file writes findings as one JSON document, for scripts."""

from __future__ import annotations

import json
from typing import Any

from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.lint.engine import LintReport

__all__ = ["render"]


def render(report: LintReport) -> str:
    """Return `{version, files, findings}`; lines and columns start at 1, ends are one past the last character."""
    document = {
        "version": 1,
        "files": [{"file": judged.file, "fixed": judged.fixed} for judged in report.files],
        "findings": [_finding(finding) for finding in report.findings],
    }
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _finding(finding: Finding) -> dict[str, Any]:
    span = finding.span
    place = {}
    if span is not None:
        place = {
            "file": span.file,
            "line": span.line,
            "column": span.column,
            "end_line": span.end_line,
            "end_column": span.end_column,
        }
    return {
        "rule": finding.rule,
        "severity": finding.severity.value,
        "message": finding.message,
        "help": finding.help,
        **place,
        "fix": None if finding.fix is None else {"text": finding.fix.text},
    }
