"""Terminal output: findings with source excerpts, escaped tables and lines, and output options."""

from __future__ import annotations

from pathlib import Path

import pytest

from mosaico_ingest.cli.console import (
    PlainTable,
    Terminal,
    print_line,
    read_sources,
    render_findings,
)
from mosaico_ingest.cli.options import write_output
from mosaico_ingest.findings import Finding, Severity, Span


def render(text: str, span: Span, message: str = "wrong", help_text: str | None = None) -> str:
    return render_findings([Finding("a-rule", Severity.ERROR, message, span, help_text)], {"j": text}).plain


def test_render_findings_with_span_puts_caret_under_span() -> None:
    assert render("bag:\n  path: x\n", Span("j", 2, 9, 2, 10), help_text="mend it") == (
        "j:2:9: error[a-rule] wrong\n  |\n2 |   path: x\n  |         ^\n  = help: mend it"
    )


def test_render_findings_wide_character_takes_two_columns() -> None:
    assert render("日本: on", Span("j", 1, 5, 1, 7)).splitlines()[-1] == "  |       ^^"


def test_render_findings_multiline_span_marks_first_line() -> None:
    assert render("a: {\n b: 1}", Span("j", 1, 4, 2, 7)).splitlines()[-1] == "  |    ^"


def test_render_findings_long_line_is_cropped_around_span() -> None:
    text = render("x" * 500 + "HERE" + "x" * 500, Span("j", 1, 501, 1, 505))
    assert "HERE" in text
    assert max(len(line) for line in text.splitlines()) < 180


def test_render_findings_secret_in_source_is_masked() -> None:
    text = render("target: {hst: h, api_key: s3cret}", Span("j", 1, 10, 1, 13))
    assert "s3cret" not in text
    assert "api_key: ******}" in text
    assert "abcd" not in render(f"note: msco_{'abcd' * 8}_12345678", Span("j", 1, 1, 1, 5))


def test_render_findings_without_span_is_one_line() -> None:
    assert render_findings([Finding("r", Severity.WARNING, "m")], {}).plain == "warning[r] m"


def test_render_findings_control_characters_are_escaped() -> None:
    assert "\x1b" not in render("a: \x1b[31m", Span("j", 1, 1, 1, 2))


def test_read_sources_missing_file_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "j.yaml"
    file.write_text("a: 1")
    there = Finding("r", Severity.INFO, "m", Span(str(file), 1, 1, 1, 2))
    gone = Finding("r", Severity.INFO, "m", Span("gone.yaml", 1, 1, 1, 2))
    assert read_sources([there, gone]) == {str(file): "a: 1"}


def test_render_findings_line_break_in_message_stays_on_one_line() -> None:
    finding = Finding("r", Severity.WARNING, "topic /a\nerror: forged", help="do\nthis")
    assert render_findings([finding], {}).plain.splitlines() == [
        "warning[r] topic /a\\nerror: forged",
        " = help: do\\nthis",
    ]


def test_print_line_line_break_and_escape_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    print_line("/a\nerror: forged\x1b[2J")
    assert capsys.readouterr().out == "/a\\nerror: forged\\x1b[2J\n"


def test_plain_table_line_break_in_cell_stays_in_row(capsys: pytest.CaptureFixture[str]) -> None:
    table = PlainTable("topic")
    table.add_row("/a\nerror: forged")
    Terminal().print(table)
    assert [line.strip() for line in capsys.readouterr().out.splitlines()] == ["topic", "/a\\nerror: forged"]


def test_write_output_dash_writes_to_stdout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_output(Path("-"), "text\n", announce=True)
    assert capsys.readouterr() == ("text\n", "")
    assert list(tmp_path.iterdir()) == []
