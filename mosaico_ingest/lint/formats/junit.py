"""This file writes findings as JUnit XML: a suite for each file, a failed case for each finding."""

from __future__ import annotations

import re
from xml.sax.saxutils import escape, quoteattr

from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.lint.engine import Judged, LintReport

__all__ = ["render"]

_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def render(report: LintReport) -> str:
    """Return the document; a file without findings is one case that passed."""
    suites = "".join(_suite(judged) for judged in report.files)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<testsuites>\n{suites}</testsuites>\n'


def _suite(judged: Judged) -> str:
    cases = "".join(_case(finding, judged.file) for finding in judged.findings)
    count = len(judged.findings)
    cases = cases or f"    <testcase name={_attribute(judged.file)}/>\n"
    name = _attribute(judged.file)
    return f'  <testsuite name={name} tests="{max(count, 1)}" failures="{count}">\n{cases}  </testsuite>\n'


def _case(finding: Finding, file: str) -> str:
    place = file if finding.span is None else f"{finding.span.line}:{finding.span.column}"
    message = _attribute(finding.message)
    failure = f"<failure type={_attribute(finding.severity.value)} message={message}>{_text(str(finding))}</failure>"
    return f"    <testcase name={_attribute(f'{place} {finding.rule}')} classname={_attribute(file)}>{failure}</testcase>\n"


def _attribute(text: str) -> str:
    return quoteattr(_NOT_XML.sub("\ufffd", text))


def _text(text: str) -> str:
    return escape(_NOT_XML.sub("\ufffd", text))
