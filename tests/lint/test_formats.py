"""The output formats of lint for other tools."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from mosaico_ingest.lint.engine import LintReport, lint_paths
from mosaico_ingest.lint.formats import FORMATS

TEXT = "bag: {path: data/run.mcap}\nsequence: {metadata: {a: on}}\ntopics: [!/x]\nrun: {jobs: 2}\n"


@pytest.fixture
def report(project: Path) -> LintReport:
    (project / "job.yaml").write_text(TEXT)
    (project / "clean.yaml").write_text("bag: {path: data/run.mcap}\n")
    return lint_paths([project / "job.yaml", project / "clean.yaml"], env={})


def test_json_format_contains_location_and_fix_of_each_finding(report: LintReport) -> None:
    document = json.loads(FORMATS["json"](report))
    assert document["version"] == 1
    assert [Path(file["file"]).name for file in document["files"]] == ["clean.yaml", "job.yaml"]
    places = [
        (f["rule"], f["severity"], f["line"], f["column"], f["end_column"]) for f in document["findings"]
    ]
    assert places == [
        ("yaml-boolean", "error", 2, 26, 28),
        ("yaml-tag", "error", 3, 10, 13),
        ("idle-jobs", "info", 4, 13, 14),
    ]
    assert document["findings"][1]["fix"] == {"text": '"!/x"'}


def test_sarif_format_contains_rules_locations_and_fixes(report: LintReport) -> None:
    document = json.loads(FORMATS["sarif"](report))
    assert document["version"] == "2.1.0"
    (run,) = document["runs"]
    known = [rule["id"] for rule in run["tool"]["driver"]["rules"]]
    assert {result["ruleId"] for result in run["results"]} == set(known)
    assert [result["level"] for result in run["results"]] == ["error", "error", "note"]
    region = run["results"][1]["locations"][0]["physicalLocation"]["region"]
    assert region == {"startLine": 3, "startColumn": 10, "endLine": 3, "endColumn": 13}
    (change,) = run["results"][1]["fixes"][0]["artifactChanges"]
    assert change["replacements"] == [{"deletedRegion": region, "insertedContent": {"text": '"!/x"'}}]


def test_github_format_prints_one_command_per_finding(report: LintReport) -> None:
    first, *_ = FORMATS["github"](report).splitlines()
    assert first.startswith("::error file=")
    assert ",line=2,col=26,endLine=2,endColumn=28,title=yaml-boolean::on is a boolean" in first


def test_junit_format_counts_failures_per_file(report: LintReport) -> None:
    root = ET.fromstring(FORMATS["junit"](report))  # noqa: S314 - our own text
    assert [(suite.get("tests"), suite.get("failures")) for suite in root] == [("1", "0"), ("3", "3")]


@pytest.mark.parametrize("name", FORMATS)
def test_formats_render_empty_report(name: str) -> None:
    assert isinstance(FORMATS[name](LintReport(())), str)
