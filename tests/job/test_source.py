"""YAML documents: values, spans, and findings for ambiguous text."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mosaico_ingest.findings import Span
from mosaico_ingest.job.yaml_source import MAX_CHARACTERS, MAX_DEPTH, Source, load_source, resolve_plain


def read(text: str) -> Source:
    return load_source(text, file="job.yaml")


def rules_and_locations(source: Source) -> list[tuple[str, str]]:
    return [(finding.rule, str(finding.span)[len("job.yaml:") :]) for finding in source.findings]


def test_load_source_valid_document_has_span_of_every_value_and_key() -> None:
    source = read("bag:\n  path: 'a.mcap'\ntopics: [/imu, \"/cam\"]\n")
    assert source.value == {"bag": {"path": "a.mcap"}, "topics": ["/imu", "/cam"]}
    assert source.span(("bag", "path")) == Span("job.yaml", 2, 9, 2, 17)
    assert source.key_span(("bag", "path")) == Span("job.yaml", 2, 3, 2, 7)
    assert source.span(("topics", 1)) == Span("job.yaml", 3, 16, 3, 22)


def test_span_missing_value_is_that_of_enclosing_value() -> None:
    source = read("bag:\n  path: a\n")
    assert source.span(("bag", "ros_distro")) == source.span(("bag",))


def test_inner_span_unfolded_text_is_exact() -> None:
    source = read('a: "foo bar"\nb: [x.y + 1]\nc: >\n  folded\n  text\n')
    assert source.inner_span(("a",), 4, 7) == Span("job.yaml", 1, 9, 1, 12)
    assert source.inner_span(("b", 0), 2, 3) == Span("job.yaml", 2, 7, 2, 8)
    assert source.inner_span(("c",), 0, 3) == source.span(("c",))


@pytest.mark.parametrize(
    ("text", "expected", "value"),
    [
        ("topics:\n  - !/cam/*\n", [("yaml-tag", "2:5")], {"topics": ["!/cam/*"]}),
        ("topics: [/a, !/b]\n", [("yaml-tag", "1:14")], {"topics": ["/a", "!/b"]}),
        ("topics: [!cam*]", [("yaml-tag", "1:10")], {"topics": ["!cam*"]}),
        ("topics:\n  - */image\n", [("yaml-alias", "2:5")], {"topics": ["*/image"]}),
        ("topics: [*camera_info]", [("yaml-alias", "1:10")], {"topics": ["*camera_info"]}),
        ("a: @x", [("yaml-syntax", "1:4")], {"a": "@x"}),
        ("name: {stem}_x\n", [("yaml-brace", "1:7")], {"name": "{stem}_x"}),
        ("a: {host: ${HOST}, b: 1}\n", [("yaml-brace", "1:11")], {"a": {"host": "${HOST}", "b": 1}}),
        ("a:\n\tb: 1\n", [("yaml-tab", "2:1")], {"a": {"b": 1}}),
        ("a: on\n", [("yaml-boolean", "1:4")], {"a": "on"}),
        ("No: 1\n", [("yaml-boolean", "1:1")], {"No": 1}),
        ("a: 010\n", [("yaml-number", "1:4")], {"a": "010"}),
        ("a: 08\n", [("yaml-number", "1:4")], {"a": "08"}),
        ("a: 0.8\n", [], {"a": 0.8}),
        ("a: 0o10\n", [("yaml-number", "1:4")], {"a": "0o10"}),
        ("a: 1_000\n", [("yaml-number", "1:4")], {"a": "1_000"}),
        ("a: 12:30:00\n", [("yaml-number", "1:4")], {"a": "12:30:00"}),
        ("a: 1\na: 2\n", [("duplicate-key", "2:1")], {"a": 1}),
        ("a: &x 1\nb: &x 2\nc: *x\n", [("yaml-anchor", "2:4")], {"a": 1, "b": 2, "c": 2}),
        ("a: !!python/name:os.system x\n", [("yaml-tag", "1:4")], {"a": "x"}),
        ("? [a]\n: b\n", [("yaml-key", "1:3")], {}),
        ("a: 1\n---\nb: 1\n", [("yaml-documents", "2:1")], {"a": 1}),
        ("a: b: c\n", [("yaml-syntax", "1:5")], None),
        ("a: 'x\nb: 1\n", [("yaml-syntax", "1:4")], None),
        ("a: [1, 2\nb: 3\n", [("yaml-syntax", "1:4")], None),
        ("a:\n  - b\n c: 1\n", [("yaml-syntax", "3:2")], None),
        ("{${00", [("yaml-syntax", "1:1")], None),
        ("a: \0\n", [("yaml-character", "1:4")], None),
        ("a: {<<: 5}\n", [("yaml-merge", "1:9")], {"a": {}}),
        ("x: " + "[" * (MAX_DEPTH + 5), [("yaml-depth", f"1:{MAX_DEPTH + 4}")], None),
    ],
)
def test_load_source_ambiguous_yaml_is_located_finding(
    text: str, expected: list[tuple[str, str]], value: object
) -> None:
    source = read(text)
    assert rules_and_locations(source) == expected
    if value is not None:
        assert source.value == value


def test_load_source_several_mistakes_reports_all() -> None:
    text = "topics:\n  - !/a\n  - */b\nname: {stem}_1\nx: 1\nx: no\n"
    assert [rule for rule, _ in rules_and_locations(read(text))] == [
        "yaml-tag",
        "yaml-alias",
        "yaml-brace",
        "yaml-boolean",
        "duplicate-key",
    ]


def test_load_source_alias_bomb_exceeds_size_limit() -> None:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    pairs = zip("abcdefgh", "bcdefghi", strict=True)
    lines += [f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]" for old, new in pairs]
    assert [rule for rule, _ in rules_and_locations(read("\n".join(lines)))] == ["yaml-size"]


def test_load_source_too_long_document_exceeds_size_limit() -> None:
    assert [rule for rule, _ in rules_and_locations(read("#" * (MAX_CHARACTERS + 1)))] == ["yaml-size"]


def test_load_source_anchor_resolves_aliases_and_merge_keys() -> None:
    source = read("base: &base {a: 1, b: 2}\njob:\n  <<: *base\n  b: 3\n")
    assert source.value == {"base": {"a": 1, "b": 2}, "job": {"a": 1, "b": 3}}
    assert source.findings == ()
    assert source.span(("job", "a")) == source.span(("base", "a"))
    assert source.span(("job", "b")).line == 4


def test_load_source_quoted_scalar_is_text() -> None:
    assert read('a: "no"\nb: "010"\nc: !!str 5\n').value == {"a": "no", "b": "010", "c": "5"}


def test_load_source_empty_document_is_null() -> None:
    assert read("").value is None
    assert read("# nothing\n").findings == ()


@settings(max_examples=300)
@given(st.text(alphabet=st.sampled_from("ab:-[]{}!*&#|>'\"%@`,?\t\n 01.~$_<é"), max_size=60))
def test_load_source_any_text_has_spans_inside_text(text: str) -> None:
    source = read(text)
    lines = len(text.splitlines()) + 1
    assert all(1 <= span.line <= lines for span in source.spans.values())
    assert all(finding.span is not None for finding in source.findings)


def is_text_to_all(text: str) -> bool:
    """Return whether this reader reads the text that PyYAML writes as text; PyYAML does not quote 1e3."""
    return isinstance(resolve_plain(text)[0], str) or yaml.safe_dump(text).startswith(("'", '"'))


TEXT = st.text(max_size=8).filter(is_text_to_all)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=50)
@given(PLAIN)
@example({"08": None})
def test_load_source_pyyaml_output_round_trips(value: object) -> None:
    text = yaml.safe_dump(value)
    source = read(text)
    # PyYAML does not quote texts such as 08, which are numbers only for other readers.
    assert {finding.rule for finding in source.findings} <= {"yaml-number"}
    assert source.value == value
