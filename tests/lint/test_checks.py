"""Checks of job manifests: rule, location and the absence of secrets for values that lint must reject."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.lint.engine import LintReport, lint_paths
from mosaico_ingest.lint.formats import FORMATS

RUN = CliRunner()


def lint(project: Path, text: str) -> LintReport:
    file = project / "job.yaml"
    file.write_text(text)
    file.chmod(0o600)
    return lint_paths([file], env={})


def places(report: LintReport) -> list[tuple[str, int, int]]:
    """Return rule, line and column of each finding."""
    return [
        (finding.rule, finding.span.line, finding.span.column) for finding in report.findings if finding.span
    ]


@pytest.mark.parametrize(
    ("text", "rule", "location"),
    [
        ('bag: {path: data/run.mcap}\ntopics: ["/cam["]\n', "topic-pattern", (2, 15)),
        ('bag: {path: data/run.mcap}\ntopics: ["/cam[!"]\n', "topic-pattern", (2, 15)),
        ('bag: {path: data/run.mcap}\ntopics: ["/cam[]"]\n', "topic-pattern", (2, 15)),
        ('bag: {path: data/run.mcap}\ntopics: ["/cam[!]"]\n', "topic-pattern", (2, 15)),
        ('bag: {path: "s3:/x/y.mcap"}\n', "wrong-url", (1, 13)),
        ("bag: {path: data/run.mcap}\ntarget: {store: s3:/x/y}\n", "wrong-url", (2, 17)),
        ("bag: {path: data/run.mcap}\nquarantine: {path: s3://x/y}\n", "wrong-url", (2, 20)),
        ('bag: {path: "s3://x/y.mcap?regoin=a"}\n', "wrong-url", (1, 13)),
        ("bag: {path: data/run.mcap}\nquarantine: {max: 200%}\n", "wrong-value", (2, 19)),
        ("bag: {path: data/run.mcap}\nquarantine: {max_run: 100.1 %}\n", "wrong-value", (2, 23)),
        ("bag: {path: data/run.mcap}\nrun: {memory: 1B}\n", "wrong-value", (2, 15)),
        ("bag: {path: data/run.mcap}\nrun: {memory: 0.5MiB}\n", "wrong-value", (2, 15)),
    ],
)
def test_lint_invalid_value_reports_rule_and_location(
    project: Path, text: str, rule: str, location: tuple[int, int]
) -> None:
    assert places(lint(project, text)) == [(rule, *location)]


@pytest.mark.parametrize(
    "text",
    [
        'bag: {path: data/run.mcap}\ntopics: ["/cam[ab]", "/x[!a]*", "/y[]a]"]\n',
        'bag: {path: "s3://x/y.mcap?region=eu-west-1"}\n',
        "bag: {path: data/run.mcap}\nquarantine: {max: 100%, max_run: 250}\n",
        "bag: {path: data/run.mcap}\nrun: {memory: 64MiB}\n",
    ],
)
def test_lint_valid_value_reports_nothing(project: Path, text: str) -> None:
    assert places(lint(project, text)) == []


SECRETS = ("hunter2", "AKIAEXAMPLE", "sEcReT")


@pytest.mark.parametrize(
    ("url", "rules"),
    [
        ("s3://AKIAEXAMPLE:hunter2@bucket/run.mcap", {"plaintext-secret"}),
        ("s3://bucket/run.mcap?secret_key=sEcReT", {"plaintext-secret"}),
        ("https://AKIAEXAMPLE:hunter2@example.org/run.mcap", {"plaintext-secret"}),
        ("s3://bucket/run.mcap?password=sEcReT&x=1", {"plaintext-secret"}),
        ("https://example.org/run.csv?X-Amz-Signature=sEcReT", {"plaintext-secret", "unknown-format"}),
    ],
)
@pytest.mark.parametrize("section", ["bag: {{path: '{0}'}}\n", "bag: {{path: ['{0}', '{0}']}}\n"])
def test_lint_url_with_credentials_reports_secret_without_printing_it(
    project: Path, url: str, rules: set[str], section: str
) -> None:
    report = lint(project, section.format(url))
    assert {finding.rule for finding in report.findings} - {"repeated-split"} == rules
    printed = RUN.invoke(command_line(), ["lint", str(project / "job.yaml")])
    outputs = [printed.stdout, printed.stderr, *(render(report) for render in FORMATS.values())]
    outputs += [str(finding) for finding in report.findings]
    assert not [secret for secret in SECRETS for output in outputs if secret in output]


def test_lint_unknown_url_option_does_not_print_its_value(project: Path) -> None:
    report = lint(project, "bag: {path: 's3://bucket/run.mcap?token_id=hunter2x'}\n")
    assert "hunter2x" not in FORMATS["json"](report)
    report = lint(project, "bag: {path: 's3://bucket/run.mcap?endpont=hunter2x'}\n")
    (finding,) = json.loads(FORMATS["json"](report))["findings"]
    assert finding["rule"] == "wrong-url"
    assert "'endpont'" in finding["message"]
    assert "hunter2x" not in finding["message"]


def test_lint_url_with_credentials_from_variables_reports_no_secret(project: Path) -> None:
    text = "bag: {path: '${DATA:-data}/run.mcap'}\ntarget: {store: 's3://${USER}:${PASSWORD}@bucket/x'}\n"
    file = project / "job.yaml"
    file.write_text(text)
    assert lint_paths([file], env=None).findings == ()
