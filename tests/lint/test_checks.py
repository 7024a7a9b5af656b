"""Checks of job manifests: rule, location and the absence of secrets for values that lint must reject."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_recordings import define, record
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line, main
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


@pytest.mark.parametrize(
    ("text", "rule", "location"),
    [
        ("bag: {path: 's3:/bucket/run.mcap'}\n", "wrong-url", "1:13"),
        ("bag: {path: ['s3://bucket/run.mcap?regoin=x']}\n", "wrong-url", "1:14"),
        ("bag: {path: run.mcap}\ntarget: {store: 's3:/bucket/x'}\n", "wrong-url", "2:17"),
        ("bag: {path: run.mcap}\nquarantine: {max: 200%}\n", "wrong-value", "2:19"),
        ("bag: {path: run.mcap}\nrun: {memory: 1B}\n", "wrong-value", "2:15"),
    ],
)
def test_invalid_value_is_reported_alike_by_lint_plan_and_run(
    project: Path, capsys: pytest.CaptureFixture[str], text: str, rule: str, location: str
) -> None:
    record(project / "run.mcap", [("/flag", define("std_msgs/msg/Bool", "bool data\n"), 1, {"data": True})])
    job = project / "job.yaml"
    job.write_text(text)
    for command, exit_code in (("lint", 12), ("plan", 2), ("run", 2)):
        with pytest.raises(SystemExit) as stopped:
            main([command, str(job)])
        assert stopped.value.code == exit_code
        assert "".join(capsys.readouterr()).startswith(f"{job}:{location}: error[{rule}]")


@pytest.mark.parametrize(
    ("load", "expected"),
    [
        ("adapters/a.py:A, adapters/b.py:B", [("adapter-clash", 2, 36)]),
        ("adapters/a.py:A, adapters/pack.yaml", [("adapter-clash", 2, 36)]),
        ("adapters/a.py:A, adapters/a.py:A", []),
        ("adapters/a.py:A, adapters/a.py:Other", []),
        ("adapters/a.py:A, adapters/optional.yaml", []),
    ],
)
def test_lint_two_adapters_for_one_type_reports_the_second(
    project: Path, load: str, expected: list[tuple[str, int, int]]
) -> None:
    folder = project / "adapters"
    (folder / "a.py").write_text(
        'class A(Base):\n    ros_msgtype = "sensor_msgs/Temperature"\n\n'
        'class Other(Base):\n    ros_msgtype: str = "sensor_msgs/msg/Imu"\n'
    )
    (folder / "b.py").write_text('class B(Base):\n    ros_msgtype = ("a/B", "sensor_msgs/msg/Temperature")\n')
    (folder / "optional.yaml").write_text((folder / "pack.yaml").read_text() + "default: false\n")
    assert places(lint(project, f"bag: {{path: data/run.mcap}}\nadapters: {{load: [{load}]}}\n")) == expected


def test_plan_reports_png_setting_for_topic_that_is_not_an_image(project: Path) -> None:
    definition = define("std_msgs/msg/Bool", "bool data\n")
    record(project / "data" / "run.mcap", [("/flag", definition, 1, {"data": True})])
    job = project / "job.yaml"
    job.write_text("bag: {path: data/run.mcap}\ntopic_settings:\n  /flag: {image: png}\n")
    plan = RUN.invoke(command_line(), ["plan", str(job), "--json"])
    (recording,) = json.loads(plan.stdout)["recordings"]
    (note,) = [note for note in recording["notes"] if note["rule"] == "image-setting"]
    assert (note["severity"], note["location"].rpartition("job.yaml")[2]) == ("warning", ":3:11")
