"""Files and Markdown blocks are recognized as manifests, adapters and definitions, even if they contain mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mosaico_ingest.lint.documents import Kind, kind_of
from mosaico_ingest.lint.engine import LintReport, lint_paths


def lint_folder(folder: Path, name: str, content: str | bytes) -> LintReport:
    """Lint a folder that contains one file."""
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return lint_paths([folder], env={})


def rules(report: LintReport) -> list[str]:
    return [finding.rule for finding in report.findings]


def test_lint_folder_with_lock_file_skips_it(tmp_path: Path) -> None:
    report = lint_folder(tmp_path, "job.lock.json", '{"version": 1, "topics": {}, "definitions": {}}')
    assert (rules(report), [Path(skipped.file).name for skipped in report.skipped]) == ([], ["job.lock.json"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("version: 1\nbagg: {path: run.mcap}\n", ["unknown-key"]),
        ("version: 1\nsequence: {name: run}\n", ["missing-key"]),
        ('version: "1"\ntopics: [/imu]\n', ["wrong-type", "missing-key"]),
        ("bagg: {path: run.mcap}\n", ["unknown-key"]),
        ("sequense: {name: run}\non_error: {topic: ignore}\n", ["missing-key", "unknown-key"]),
        ("  version: 1\n  Bag: {path: run.mcap}\n", ["unknown-key"]),
        ("bag: {path: run.mcap}\rtopics: /imu\r", ["wrong-type"]),
        ("version: 1\rsequence: {name: run}\r", ["missing-key"]),
        ("# a comment\n---\nbag: {path: 5}\n", ["wrong-type"]),
        ("bag: {path: run.mcap\nsequence: {name: run}\n", ["yaml-syntax"]),
    ],
)
def test_lint_folder_with_broken_manifest_reports_it(tmp_path: Path, text: str, expected: list[str]) -> None:
    report = lint_folder(tmp_path, "job.yaml", text)
    assert sorted(rules(report)) == sorted(expected)
    assert report.skipped == ()


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        ({"bag": {"path": "run.mcap"}, "topics": "/imu"}, ["wrong-type"]),
        ({"version": 1, "bagg": {"path": "run.mcap"}}, ["unknown-key"]),
        ({"version": 1, "sequence": {"name": "run"}}, ["missing-key"]),
    ],
)
@pytest.mark.parametrize("indent", [None, 2])
@pytest.mark.parametrize("name", ["job.json", "job.yaml"])
def test_lint_folder_with_json_manifest_reports_its_findings(
    tmp_path: Path, document: object, expected: list[str], indent: int | None, name: str
) -> None:
    assert sorted(rules(lint_folder(tmp_path, name, json.dumps(document, indent=indent)))) == expected


@pytest.mark.parametrize(
    "content",
    [
        "bag: {path: läuft.mcap}\n".encode("latin-1"),
        "version: 1\nbag: {path: run.mcap}\n".encode("utf-16"),
        b"adapter: Pack\xff\n",
    ],
)
def test_lint_folder_with_manifest_in_another_encoding_reports_not_utf8(
    tmp_path: Path, content: bytes
) -> None:
    assert rules(lint_folder(tmp_path, "job.yaml", content)) == ["not-utf8"]


def test_lint_folder_with_msg_file_in_another_encoding_reports_not_utf8(tmp_path: Path) -> None:
    assert rules(lint_folder(tmp_path, "Pack.msg", b"# \xfc\nfloat64 volts\n")) == ["not-utf8"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("compose.yaml", 'version: "3.8"\nservices: {db: {image: postgres}}\n'),
        ("config.yml", "version: 2\njobs: {build: {}}\nworkflows: {}\n"),
        ("dependabot.yml", "version: 2\nupdates: []\n"),
        ("Taskfile.yml", "version: '3'\ntasks: {}\nrun: once\n"),
        ("mkdocs.yml", "site_name: x\nnav: []\nextra: {version: 1}\n"),
        ("package.json", '{"name": "x", "version": "1.0.0", "scripts": {"topics": "x"}}'),
        ("hooks.yaml", "- id: x\n  version: 1\n  topics: y\n"),
        ("list.json", '[{"bag": 1}]'),
        ("latin.yaml", b"name: \xff\n"),
        ("empty.yaml", ""),
    ],
)
def test_lint_folder_with_foreign_file_lists_it_as_skipped(
    tmp_path: Path, name: str, content: str | bytes
) -> None:
    report = lint_folder(tmp_path, name, content)
    assert report.files == ()
    assert [Path(skipped.file).name for skipped in report.skipped] == [name]
    assert report.exit_code == 3


def test_lint_folder_does_not_list_pages_and_other_files(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("# Title\n")
    (tmp_path / "data.csv").write_text("a,b\n")
    assert lint_paths([tmp_path], env={}) == LintReport(())


def test_lint_named_foreign_file_checks_it_as_job(tmp_path: Path) -> None:
    file = tmp_path / "compose.yaml"
    file.write_text("services: {}\n")
    report = lint_paths([tmp_path, file], env={})
    assert sorted(rules(report)) == ["missing-key", "unknown-key"]
    assert report.skipped == ()


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("adapter: X\n", Kind.ADAPTER),
        ("version: 1\nadaptr: X\n", Kind.ADAPTER),
        ("version: 1\nbga: {path: .}\n", Kind.JOB),
        ("version: 1\ntag: x\n", None),
        ("ontology: IMU\nfields: {a: b}\n", Kind.ADAPTER),
        ("sequence: {adapter: X}\n", None),
        ("extends: base.yaml\n", Kind.JOB),
        ("text: |\n  bag: x\n  topics: y\n", None),
    ],
)
def test_kind_of_uses_top_level_keys(text: str, kind: Kind | None) -> None:
    assert kind_of(text) is kind


def test_markdown_block_needs_a_certain_key(tmp_path: Path) -> None:
    page = "```yaml\nversion: 1\ntopics: /imu\n```\n\n```yaml\nbag: {path: run.mcap}\ntopics: /imu\n```\n"
    report = lint_folder(tmp_path, "page.md", page)
    assert [(finding.rule, finding.span and finding.span.line) for finding in report.findings] == [
        ("wrong-type", 8)
    ]
