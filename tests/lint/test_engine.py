"""The lint engine: files, folders, standard input, comments, settings, Markdown pages and fixes."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Literal

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.errors import ManifestError, NothingMatched
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.lint.engine import LintReport, lint_paths
from mosaico_ingest.pipeline.compile import compile_manifest
from mosaico_ingest.rules import LINT_RULES

GOOD = "bag: {path: data/run.mcap}\n"
TRAP = "bag: {path: data/run.mcap}\nsequence: {metadata: {a: on}}\n"


def lint(project: Path, text: str | bytes, name: str = "job.yaml", *, fix: bool = False) -> LintReport:
    file = project / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    report = lint_paths([file], env={}, fix=fix)
    assert {finding.rule for finding in report.findings} <= set(LINT_RULES)
    return report


def rules(report: LintReport) -> list[str]:
    return [finding.rule for finding in report.findings]


def test_lint_paths_without_findings_exits_with_0(project: Path) -> None:
    assert lint(project, GOOD).exit_code == 0


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (TRAP, 12),
        ("bag: {path: data/run.db3}\n", 11),
        ("bag: {path: data/run.mcap}\nrun: {jobs: 2}\n", 10),
    ],
)
def test_lint_paths_exit_code_follows_worst_severity(project: Path, text: str, code: int) -> None:
    assert lint(project, text).exit_code == code


def test_lint_paths_without_documents_exits_with_3(tmp_path: Path) -> None:
    (tmp_path / "compose.yaml").write_text("services: {}\n")
    assert lint_paths([tmp_path], env={}).exit_code == 3


def test_lint_paths_folder_checks_all_documents_below_it(project: Path) -> None:
    (project / "deep").mkdir()
    (project / "deep" / "job.yml").write_text(TRAP)
    (project / "deep" / "other.yaml").write_text("services: {a: on}\n")
    (project / ".git" / "job.yaml").write_text(TRAP)
    report = lint_paths([project], env={})
    names = [Path(file.file).relative_to(project).as_posix() for file in report.files]
    assert names == [
        "adapters/pack.yaml",
        "adapters/pack_v2.yaml",
        "deep/job.yml",
        "msgs/BatteryPack.msg",
        "msgs/Cell.msg",
    ]
    assert rules(report) == ["yaml-boolean"]


def test_lint_paths_dash_checks_standard_input() -> None:
    report = lint_paths(["-"], env={}, stdin=TRAP)
    assert str(report.findings[0].span) == "-:2:26"


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (b"\xff", "not-utf8"),
        (b"bag: \0", "yaml-character"),
        (b"", "empty-manifest"),
        (b"- a", "not-a-mapping"),
    ],
)
def test_lint_paths_named_file_that_is_not_a_manifest_reports_it(
    project: Path, content: bytes, rule: str
) -> None:
    assert rules(lint(project, content)) == [rule]


def test_lint_paths_missing_file_reports_unreadable_file(tmp_path: Path) -> None:
    assert rules(lint_paths([tmp_path / "job.yaml"], env={})) == ["unreadable-file"]


def test_lint_invalid_values_do_not_hide_other_findings(project: Path) -> None:
    text = """
bag: {path: [data/a.mcap, 5], ros_distro: humble, typo: 1}
sequence: {name: a b}
topics: [/a, /camera/.*]
run: {jobs: many}
"""
    assert rules(lint(project, text)) == [
        "wrong-type", "wrong-value", "unknown-key", "sequence-name", "topic-pattern", "wrong-type",
    ]  # fmt: skip


def test_lint_missing_bag_does_not_hide_other_findings(project: Path) -> None:
    assert rules(lint(project, "sequence: {name: a b}\n")) == ["missing-key", "sequence-name"]


@pytest.mark.parametrize("word", ["yaml-boolean", "ING007"])
def test_ignore_comment_suppresses_rule_on_its_line(project: Path, word: str) -> None:
    text = f"bag: {{path: data/run.mcap}}\nsequence: {{metadata: {{a: on}}}}  # ingest: ignore[{word}]\n"
    assert rules(lint(project, text)) == []


def test_ignore_comment_alone_on_line_suppresses_rule_on_next_line(project: Path) -> None:
    text = "bag: {path: data/run.mcap}\n# ingest: ignore[yaml-boolean]\nsequence: {metadata: {a: on}}\n"
    assert rules(lint(project, text)) == []


@pytest.mark.parametrize(
    ("comment", "start", "end"),
    [
        ("# ingest: ignore", 27, 43),
        ("# ingest: ignore-file", 27, 48),
        ("# ingest: ignore[]", 27, 45),
        ("# ingest: ignor[yaml-boolean]", 27, 56),
        ("# ingest: ignore[yaml-bolean]", 44, 55),
        ("# ingest: ignore[unmatched-pattern]", 44, 61),
    ],
)
def test_ignore_comment_without_known_lint_rule_is_reported(
    project: Path, comment: str, start: int, end: int
) -> None:
    (finding,) = lint(project, f"bag: {{path: data/run.mcap}}{comment}\n").findings
    assert finding.rule == "unknown-rule"
    assert finding.span is not None
    assert (finding.span.column, finding.span.end_column) == (start, end)


def test_comment_without_ignore_is_not_reported(project: Path) -> None:
    assert rules(lint(project, f"# ingest: nightly run\n{GOOD}")) == []


def test_ignore_file_comment_suppresses_rule_in_entire_file(project: Path) -> None:
    assert rules(lint(project, f"# ingest: ignore-file[yaml-boolean]\n{TRAP}")) == []


def test_settings_change_severities_and_exclude_files(project: Path) -> None:
    (project / ".ingest.yaml").write_text(
        "lint:\n  severity: {ING007: 'off', idle-jobs: error}\n  exclude: [old/*]\n"
    )
    (project / "old").mkdir()
    (project / "old" / "job.yaml").write_text(TRAP)
    (project / "job.yaml").write_text(TRAP + "run: {jobs: 2}\n")
    report = lint_paths([project], env={})
    assert [(finding.rule, finding.severity.value) for finding in report.findings] == [("idle-jobs", "error")]


def test_settings_in_pyproject_apply(project: Path) -> None:
    (project / "pyproject.toml").write_text('[tool.ingest.lint]\nseverity = {yaml-boolean = "info"}\n')
    assert lint(project, TRAP).exit_code == 10


@pytest.mark.parametrize(
    "text",
    ["lint: {severity: {yaml-bolean: info}}", "lint: {severity: {ING007: loud}}", "lnt: {}", "lint: ["],
)
def test_invalid_settings_raise_manifest_error(project: Path, text: str) -> None:
    (project / ".ingest.yaml").write_text(text)
    with pytest.raises(ManifestError):
        lint(project, GOOD)


def test_lint_markdown_reports_findings_at_lines_of_page(project: Path) -> None:
    page = f"# Title\n\n```yaml\n{TRAP}```\n\n```yaml\nservices: on\n```\n\n```text\nbag: on\n```\n"
    report = lint(project, page, "page.md")
    assert [(finding.rule, finding.span and finding.span.line) for finding in report.findings] == [
        ("yaml-boolean", 5)
    ]


def test_lint_markdown_example_may_name_missing_files(project: Path) -> None:
    page = "```yaml\nbag: {path: data/run.mcap}\nadapters: {load: [nowhere.yaml, x.y:Z]}\n```\n"
    assert rules(lint(project, page, "page.md")) == []


BROKEN = """\
# A comment stays.
bag:
    path:   data/run.mcap   # and so does this
    ros_distro: Humble
Sequence:
  name: {stem}_raw
topics: [/cam/*, !/cam/debug,   */image]
run: {jobs: "2"}
"""
FIXED = """\
# A comment stays.
bag:
    path:   data/run.mcap   # and so does this
    ros_distro: ros2_humble
sequence:
  name: "{stem}_raw"
topics: [/cam/*, "!/cam/debug",   "*/image"]
run: {jobs: 2}
"""


def test_fix_keeps_comments_and_layout_and_applies_once(project: Path) -> None:
    report = lint(project, BROKEN, fix=True)
    assert (project / "job.yaml").read_text() == FIXED
    assert report.exit_code == 10  # idle-jobs has no fix
    assert report.files[0].fixed == 6
    assert lint_paths([project / "job.yaml"], env={}, fix=True).files[0].fixed == 0


def test_fix_keeps_line_ends(project: Path) -> None:
    lint(project, BROKEN.replace("\n", "\r\n"), fix=True)
    assert (project / "job.yaml").read_bytes() == FIXED.replace("\n", "\r\n").encode()


def test_fix_with_byte_order_mark_edits_correct_columns(project: Path) -> None:
    lint(project, "\ufeffbag: {path: 5}\n", fix=True)
    assert (project / "job.yaml").read_text() == 'bag: {path: "5"}\n'


def test_lint_adapter_finds_used_adapter_in_same_folder(project: Path) -> None:
    text = """\
version: 1
adapter: StampedPackAdapter
ros_type: sensor_msgs/msg/Temperature
ontology: Temperature
fields:
  value: temperature
  header: {use: %s, of: header}
"""
    assert rules(lint(project, text % "HeaderAdapter", "adapters/other.yaml")) == []
    assert rules(lint(project, text % "NoAdapter", "adapters/other.yaml")) == ["unknown-adapter"]
    assert rules(lint(project, text % "PackAdapter", "adapters/other.yaml")) == ["type-mismatch"]


def test_lint_adapter_definition_applies_to_first_type_only(project: Path) -> None:
    text = """\
version: 1
adapter: TwoTypesAdapter
ros_type: [acme_msgs/msg/Heat, sensor_msgs/msg/Temperature]
ontology: Temperature
fields: {value: degrees}
definition: float64 degrees
"""
    report = lint(project, text, "adapters/two.yaml")
    assert rules(report) == ["unknown-field"]
    assert "sensor_msgs/msg/Temperature" in report.findings[0].message


def test_lint_without_fix_does_not_change_files(project: Path) -> None:
    lint(project, BROKEN)
    assert (project / "job.yaml").read_text() == BROKEN


VALUES = st.recursive(
    st.sampled_from(["on", "/cam/*", "!/x", "${A}", "{stem}", "a b", "", 1, -1, 1.5, True, None]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "/imu", "default", "name", "path"]), inner, max_size=3)
    ),
    max_leaves=5,
)
KEYS = [
    "path",
    "ros_distro",
    "custom_msgs",
    "time",
    "name",
    "metadata",
    "if_exists",
    "load",
    "override",
    "unmodeled",
]
KEYS += [
    "session",
    "topic",
    "message",
    "store",
    "host",
    "port",
    "api_key",
    "jobs",
    "memory",
    "report",
    "/imu",
]
SECTIONS = st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=4) | VALUES
JOBS = st.fixed_dictionaries(
    {"bag": st.just({"path": "data/run.mcap"}) | SECTIONS},
    optional=dict.fromkeys(
        ("sequence", "topics", "topic_settings", "adapters", "on_error", "target", "run", "version"), SECTIONS
    ),
)


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(job=JOBS, style=st.sampled_from([None, True, False]))
def test_manifest_without_errors_compiles(
    project: Path, job: object, style: Literal[True, False] | None
) -> None:
    (project / "data" / "run.mcap").touch()
    report = lint(project, yaml.safe_dump(job, default_flow_style=style))
    if report.exit_code < 12:
        with suppress(NothingMatched):  # lint does not open recordings
            assert compile_manifest(load_manifest(project / "job.yaml", env={}))


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(text=st.text(alphabet="abg:-[]{}!*&#|>'\"%@`,?\t\n 01.~$_<é", max_size=80))
def test_lint_arbitrary_text_reports_registered_rules_only(project: Path, text: str) -> None:
    lint(project, f"bag: {{path: data/run.mcap}}\n{text}")


@pytest.mark.slow
def test_lint_500_manifests_takes_less_than_5_seconds(tmp_path: Path) -> None:
    example = (Path(__file__).parents[1] / "job" / "test_load.py").read_text()
    text = example.split('FULL = """\\\n')[1].split('"""')[0]
    for number in range(500):
        (tmp_path / f"job_{number:03}.yaml").write_text(text)
    lint_paths([tmp_path / "job_000.yaml"], env=None)
    start = time.perf_counter()
    assert len(lint_paths([tmp_path], env=None).files) == 500
    assert time.perf_counter() - start < 5


def test_lint_without_environment_does_not_report_unset_variables(project: Path) -> None:
    file = project / "job.yaml"
    file.write_text("bag: {path: '${NOT_SET_ANYWHERE}'}\n")
    assert rules(lint_paths([file], env=os.environ)) == ["unset-variable"]
    assert rules(lint_paths([file], env=None)) == []
