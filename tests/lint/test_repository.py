"""The documents of this repository have no findings, and the integrations of lint fit its output."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.lint.engine import lint_paths

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("path", ["configs", "docs", "README.md"])
def test_files_of_repository_have_no_findings(path: str) -> None:
    assert [str(finding) for finding in lint_paths([ROOT / path], env=None).findings] == []


@pytest.mark.slow
def test_catalog_has_no_findings() -> None:
    catalog = ROOT / "mosaico_ingest" / "adapters" / "catalog"
    report = lint_paths([catalog], env=None)
    assert [str(finding) for finding in report.findings] == []
    assert len(report.files) == len(list(catalog.glob("*.yaml")))


def test_problem_matcher_parses_printed_finding() -> None:
    matcher = json.loads((ROOT / ".github" / "problem-matcher.json").read_text())
    (pattern,) = matcher["problemMatcher"][0]["pattern"]
    line = str(Finding("yaml-tag", Severity.WARNING, "the message", Span("a/job.yaml", 3, 5, 3, 9)))
    match = re.fullmatch(pattern["regexp"], line)
    assert match is not None
    assert [match[pattern[key]] for key in ("file", "line", "column", "severity", "code", "message")] == [
        "a/job.yaml", "3", "5", "warning", "yaml-tag", "the message",
    ]  # fmt: skip


def test_pre_commit_hooks_run_lint_for_their_files() -> None:
    lint, fix = yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text())
    assert lint["entry"].split()[:2] == ["ingest", "lint"]
    assert fix["entry"].split()[:3] == ["ingest", "lint", "--fix"]
    for name in ("configs/quickstart.yaml", "job.yml", "job.json"):
        assert re.search(lint["files"], name)
        assert re.search(fix["files"], name)
    for name in ("msgs/Pack.msg", "docs/ci.md"):
        assert re.search(lint["files"], name)
