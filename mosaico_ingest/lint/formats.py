"""The output formats of lint: JSON, SARIF 2.1.0, GitHub annotations and JUnit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import quote
from xml.sax.saxutils import escape, quoteattr

from mosaico_ingest.findings import Edit, Finding, Severity, Span, mask_credentials
from mosaico_ingest.lint.engine import LintedFile, LintReport
from mosaico_ingest.lint.pages import page_of
from mosaico_ingest.rules import RULES, Rule
from mosaico_ingest.version import __version__


def _render_json(report: LintReport) -> str:
    """Return `{version, files, skipped, findings}`. Lines and columns start at 1; end columns are exclusive."""
    document = {
        "version": 1,
        "files": [{"file": linted.file, "fixed": linted.fixed} for linted in report.files],
        "skipped": [{"file": skipped.file, "reason": skipped.reason} for skipped in report.skipped],
        "findings": [_finding(finding) for finding in report.findings],
    }
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _finding(finding: Finding) -> dict[str, Any]:
    span = finding.span
    location = {}
    if span is not None:
        location = {
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
        **location,
        "fix": None if finding.fix is None else {"text": mask_credentials(finding.fix.text)},
    }


_COMMANDS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "notice"}
_ESCAPES = (("%", "%25"), ("\r", "%0D"), ("\n", "%0A"))


def _render_github(report: LintReport) -> str:
    """Return one workflow command per finding."""
    return "".join(f"{_line(finding)}\n" for finding in report.findings)


def _line(finding: Finding) -> str:
    location = ""
    if finding.span is not None:
        span = finding.span
        ends = f",endLine={span.end_line}"
        ends += f",endColumn={span.end_column}" if span.line == span.end_line else ""
        location = f"file={_property(span.file)},line={span.line},col={span.column}{ends},"
    text = f"{finding.message} — {finding.help}" if finding.help else finding.message
    return f"::{_COMMANDS[finding.severity]} {location}title={_property(finding.rule)}::{_escaped(text)}"


def _escaped(text: str) -> str:
    for character, code in _ESCAPES:
        text = text.replace(character, code)
    return text


def _property(text: str) -> str:
    return _escaped(text).replace(":", "%3A").replace(",", "%2C")


_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _render_junit(report: LintReport) -> str:
    """Return one test suite per file. A file without findings is one passed test case."""
    suites = "".join(_suite(linted) for linted in report.files)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<testsuites>\n{suites}</testsuites>\n'


def _suite(linted: LintedFile) -> str:
    cases = "".join(_case(finding, linted.file) for finding in linted.findings)
    count = len(linted.findings)
    cases = cases or f"    <testcase name={_attribute(linted.file)}/>\n"
    name = _attribute(linted.file)
    return f'  <testsuite name={name} tests="{max(count, 1)}" failures="{count}">\n{cases}  </testsuite>\n'


def _case(finding: Finding, file: str) -> str:
    location = file if finding.span is None else f"{finding.span.line}:{finding.span.column}"
    message = _attribute(finding.message)
    failure = f"<failure type={_attribute(finding.severity.value)} message={message}>{_text(str(finding))}</failure>"
    return f"    <testcase name={_attribute(f'{location} {finding.rule}')} classname={_attribute(file)}>{failure}</testcase>\n"


def _attribute(text: str) -> str:
    return quoteattr(_NOT_XML.sub("\ufffd", text))


def _text(text: str) -> str:
    return escape(_NOT_XML.sub("\ufffd", text))


_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_LEVELS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "note"}


def _render_sarif(report: LintReport) -> str:
    """Return one run with the findings, their rules and their fixes."""
    reported = {finding.rule for finding in report.findings}
    driver = {
        "name": "mosaico-ingest",
        "semanticVersion": __version__,
        "rules": [_rule(rule) for rule in RULES.values() if rule.id in reported],
    }
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "results": [_result(finding) for finding in report.findings],
    }
    return json.dumps({"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2) + "\n"


def _rule(rule: Rule) -> dict[str, Any]:
    return {
        "id": rule.id,
        "name": rule.code,
        "shortDescription": {"text": rule.summary},
        "help": {"text": page_of(rule), "markdown": page_of(rule)},
        "defaultConfiguration": {"level": _LEVELS[rule.severity]},
    }


def _result(finding: Finding) -> dict[str, Any]:
    text = f"{finding.message}: {finding.help}" if finding.help else finding.message
    result: dict[str, Any] = {
        "ruleId": finding.rule,
        "level": _LEVELS[finding.severity],
        "message": {"text": text},
    }
    if finding.span is not None:
        result["locations"] = [{"physicalLocation": _location(finding.span)}]
    if finding.fix is not None:
        result["fixes"] = [_fix(finding.fix)]
    return result


def _location(span: Span) -> dict[str, Any]:
    return {"artifactLocation": {"uri": quote(span.file)}, "region": _region(span)}


def _region(span: Span) -> dict[str, int]:
    return {
        "startLine": span.line,
        "startColumn": span.column,
        "endLine": span.end_line,
        "endColumn": span.end_column,
    }


def _fix(edit: Edit) -> dict[str, Any]:
    replacement = {
        "deletedRegion": _region(edit.span),
        "insertedContent": {"text": mask_credentials(edit.text)},
    }
    change = {"artifactLocation": {"uri": quote(edit.span.file)}, "replacements": [replacement]}
    return {
        "description": {"text": f"replace with {mask_credentials(edit.text)}"},
        "artifactChanges": [change],
    }


FORMATS: dict[str, Callable[[LintReport], str]] = {
    "json": _render_json,
    "sarif": _render_sarif,
    "github": _render_github,
    "junit": _render_junit,
}
"""The renderer of each `--format`."""
