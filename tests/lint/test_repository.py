"""Everything of ours in this repository is clean, and what others use to call the linter fits it."""

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
def test_every_configuration_and_every_yaml_block_is_clean(path: str) -> None:
    assert [str(finding) for finding in lint_paths([ROOT / path], env=None).findings] == []


@pytest.mark.slow
def test_every_adapter_of_the_catalog_is_clean() -> None:
    catalog = ROOT / "mosaico_ingest" / "adapters" / "catalog"
    report = lint_paths([catalog], env=None)
    assert [str(finding) for finding in report.findings] == []
    assert len(report.files) == len(list(catalog.glob("*.yaml")))


def test_the_problem_matcher_reads_what_is_printed() -> None:
    matcher = json.loads((ROOT / ".github" / "problem-matcher.json").read_text())
    (pattern,) = matcher["problemMatcher"][0]["pattern"]
    line = str(Finding("yaml-tag", Severity.WARNING, "the message", Span("a/job.yaml", 3, 5, 3, 9)))
    found = re.fullmatch(pattern["regexp"], line)
    assert found is not None
    assert [found[pattern[key]] for key in ("file", "line", "column", "severity", "code", "message")] == [
        "a/job.yaml", "3", "5", "warning", "yaml-tag", "the message",
    ]  # fmt: skip


def test_the_hook_calls_the_linter() -> None:
    (hook,) = yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text())
    assert hook["entry"].split()[:2] == ["ingest", "lint"]
    assert re.search(hook["files"], "configs/quickstart.yaml")
