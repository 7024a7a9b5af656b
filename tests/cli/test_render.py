"""Findings are drawn with the line they are about and a caret under the exact place."""

from __future__ import annotations

from pathlib import Path

from mosaico_ingest.cli.console import render_findings, texts_of
from mosaico_ingest.findings import Finding, Severity, Span


def drawn(text: str, span: Span, message: str = "wrong", remedy: str | None = None) -> str:
    return render_findings([Finding("a-rule", Severity.ERROR, message, span, remedy)], {"j": text}).plain


def test_the_caret_lies_under_the_span() -> None:
    assert drawn("bag:\n  path: x\n", Span("j", 2, 9, 2, 10), remedy="mend it") == (
        "j:2:9: error[a-rule] wrong\n  |\n2 |   path: x\n  |         ^\n  = help: mend it"
    )


def test_a_wide_character_takes_two_columns() -> None:
    assert drawn("日本: on", Span("j", 1, 5, 1, 7)).splitlines()[-1] == "  |       ^^"


def test_a_span_over_several_lines_is_marked_to_the_end_of_its_first() -> None:
    assert drawn("a: {\n b: 1}", Span("j", 1, 4, 2, 7)).splitlines()[-1] == "  |    ^"


def test_a_long_line_is_cut_around_the_span() -> None:
    text = drawn("x" * 500 + "HERE" + "x" * 500, Span("j", 1, 501, 1, 505))
    assert "HERE" in text
    assert max(len(line) for line in text.splitlines()) < 180


def test_a_secret_is_not_drawn() -> None:
    text = drawn("target: {hst: h, api_key: s3cret}", Span("j", 1, 10, 1, 13))
    assert "s3cret" not in text
    assert "api_key: ******}" in text
    assert "abcd" not in drawn(f"note: msco_{'abcd' * 8}_12345678", Span("j", 1, 1, 1, 5))


def test_a_finding_without_a_place_is_one_line() -> None:
    assert render_findings([Finding("r", Severity.WARNING, "m")], {}).plain == "warning[r] m"


def test_control_characters_do_not_reach_the_terminal() -> None:
    assert "\x1b" not in drawn("a: \x1b[31m", Span("j", 1, 1, 1, 2))


def test_the_texts_of_findings_are_read(tmp_path: Path) -> None:
    file = tmp_path / "j.yaml"
    file.write_text("a: 1")
    there = Finding("r", Severity.INFO, "m", Span(str(file), 1, 1, 1, 2))
    gone = Finding("r", Severity.INFO, "m", Span("gone.yaml", 1, 1, 1, 2))
    assert texts_of([there, gone]) == {str(file): "a: 1"}
