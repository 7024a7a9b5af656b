"""The output formats of lint: JSON, SARIF 2.1.0, GitHub annotations and JUnit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any
from urllib.parse import quote
from xml.sax.saxutils import escape, quoteattr

from msgspec import Struct

from mosaico_ingest.findings import Edit, Finding, Severity, Span, mask_credentials
from mosaico_ingest.lint.engine import LintedFile, LintReport
from mosaico_ingest.rules import RULES, Rule, page_of
from mosaico_ingest.version import __version__

JUNIT_START = '<?xml version="1.0" encoding="UTF-8"?>\n<testsuites>\n'
JUNIT_END = "</testsuites>\n"
_COMMANDS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "notice"}
_ESCAPES = (("%", "%25"), ("\r", "%0D"), ("\n", "%0A"))
_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_LEVELS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "note"}


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


class Case(Struct, frozen=True):
    """One test case of a JUnit file; it passed if it has neither a finding nor a reason why it was skipped."""

    name: str
    class_name: str
    failure: Finding | None = None
    skipped: str | None = None
    span: Span | None = None
    """The location of the test, such as a key of a manifest."""


class Suite(Struct, frozen=True):
    """The test cases of one file or recording."""

    name: str
    cases: tuple[Case, ...]


def junit_text(suites: Iterable[Suite]) -> str:
    """Return test suites as JUnit XML."""
    return f"{JUNIT_START}{''.join(map(suite_text, suites))}{JUNIT_END}"


def _render_junit(report: LintReport) -> str:
    """Return one test suite per file. A file without findings is one passed test case."""
    return junit_text(map(_file_suite, report.files))


def _file_suite(linted: LintedFile) -> Suite:
    file = linted.file
    cases = tuple(
        Case(_case_name(finding, file), file, failure=finding, span=finding.span)
        for finding in linted.findings
    )
    return Suite(file, cases or (Case(file, file),))


def _case_name(finding: Finding, file: str) -> str:
    location = file if finding.span is None else f"{finding.span.line}:{finding.span.column}"
    return f"{location} {finding.rule}"


def suite_text(suite: Suite) -> str:
    """Return a test suite as a part of JUnit XML, between `JUNIT_START` and `JUNIT_END`."""
    failures = sum(case.failure is not None for case in suite.cases)
    skipped = sum(case.skipped is not None for case in suite.cases)
    counts = f'tests="{len(suite.cases)}" failures="{failures}" skipped="{skipped}"'
    cases = "".join(map(_case, suite.cases))
    return f"  <testsuite name={_attribute(suite.name)} {counts}>\n{cases}  </testsuite>\n"


def _case(case: Case) -> str:
    head = f"    <testcase name={_attribute(case.name)} classname={_attribute(case.class_name)}"
    if case.span is not None:
        head += f' file={_attribute(case.span.file)} line="{case.span.line}"'
    if case.failure is not None:
        kind, message = _attribute(case.failure.severity.value), _attribute(case.failure.message)
        failure = f"<failure type={kind} message={message}>{_text(str(case.failure))}</failure>"
        return f"{head}>{failure}</testcase>\n"
    if case.skipped is not None:
        return f"{head}><skipped message={_attribute(case.skipped)}/></testcase>\n"
    return f"{head}/>\n"


def _attribute(text: str) -> str:
    return quoteattr(_NOT_XML.sub("\ufffd", text))


def _text(text: str) -> str:
    return escape(_NOT_XML.sub("\ufffd", text))


def _render_sarif(report: LintReport) -> str:
    return sarif_text(report.findings)


def sarif_text(findings: Sequence[Finding]) -> str:
    """Return one SARIF run with the findings, their rules and their fixes."""
    reported = {finding.rule for finding in findings}
    driver = {
        "name": "mosaico-ingest",
        "semanticVersion": __version__,
        "rules": [_rule(rule) for rule in RULES.values() if rule.id in reported],
    }
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "results": [_result(finding) for finding in findings],
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
