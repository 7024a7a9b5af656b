from __future__ import annotations

import pytest

from mosaico_ingest.adapters.mapping.expressions import (
    Attribute,
    Call,
    EachElement,
    ExpressionError,
    ListLiteral,
    Literal,
    Name,
    Subscript,
    Ternary,
    parse,
)

AT = (0, 0)


def refused(text: str) -> tuple[str, str]:
    with pytest.raises(ExpressionError) as caught:
        parse(text)
    start, end = caught.value.span
    return text[start:end], str(caught.value)


def test_parse_names_attributes_and_lists() -> None:
    assert parse("a.b[].c") == Attribute(EachElement(Attribute(Name("a", AT), "b", AT, AT), AT), "c", AT, AT)
    assert parse("a[-1]") == Subscript(Name("a", AT), -1, AT)
    assert parse("[]") == ListLiteral((), AT)
    assert parse("self['from']") == Attribute(Name("self", AT), "from", AT, AT)


def test_parse_yaml_words_as_literals() -> None:
    assert parse("null") == Literal(None, AT)
    assert parse("true") == Literal(value=True, span=AT)
    assert parse("-1.5") == Literal(-1.5, AT)


def test_parse_operators_as_calls() -> None:
    assert parse("a + 1") == Call("+", (Name("a", AT), Literal(1, AT)), AT, AT)
    assert parse("a < b < c") == parse("a < b and b < c")
    assert parse("a in [1, 2]") == parse("a == 1 or a == 2")
    assert parse("a not in [1]") == parse("not (a == 1)")


def test_parse_if_else_as_ternary() -> None:
    assert parse("if_else(a, b, c)") == parse("b if a else c")
    assert isinstance(parse("b if a else c"), Ternary)


@pytest.mark.parametrize(
    "text",
    [
        "lambda x: x",
        "[x for x in y]",
        "{1: 2}",
        "(a, b)",
        "f'{a}'",
        "(a := 1)",
        "b'bytes'",
        "...",
        "*a",
        "1j",
        "a @ b",
        "a is b",
        "a[1:2:3]",
        "a.b()",
        "f(x=1)",
        "f(*a)",
        "await a",
        "",
        "   ",
        "1 +",
        "a b",
        "a.from",
        "36893488147419103232",
        "(" * 500 + ")" * 500,
        "a + " * 200 + "a" + " " * 4000,
        "-" * 100 + "a",
        "\0",
    ],
)
def test_parse_unsupported_syntax_raises(text: str) -> None:
    refused(text)


def test_parse_error_span_is_offending_part() -> None:
    assert refused("cells[].x + (lambda: 1)")[0] == "lambda: 1"
    assert refused("'ü€' + b'x'")[0] == "b'x'"
    assert refused("f(a[], b[c:d:e])")[0] == "c:d:e"
    assert refused("x.y(1)")[0] == "x.y"
    assert refused("1 +")[0] == "+"


def test_parse_spans_count_characters_of_source() -> None:
    text = "a[].b + 'ü' + c[].d"
    node = parse(text)
    assert isinstance(node, Call)
    last = node.arguments[1]
    assert text[last.span[0] : last.span[1]] == "c[].d"


def test_parse_keeps_brackets_in_text() -> None:
    assert parse("'a[]'") == Literal("a[]", AT)
    assert parse(r"extract(s, '\d[]]')").arguments[1].value == r"\d[]]"  # type: ignore[union-attr]  # it is a call


def test_parse_joins_lines_of_folded_text() -> None:
    assert parse("a +\n  b") == parse("a + b")
