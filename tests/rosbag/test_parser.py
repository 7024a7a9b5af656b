"""Reading and writing `.msg` text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import (
    Constant,
    Container,
    Field,
    parse_msg,
    read_types,
    sections,
)


def field_of(line: str) -> Field:
    return parse_msg(line, "pkg/msg/Name").fields[0]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("float64 x", Field("x", "float64")),
        ("  float64\tx   # metres", Field("x", "float64")),
        ("string<=10 name", Field("name", "string", string_bound=10)),
        ("wstring text", Field("text", "wstring")),
        ("uint8[] data", Field("data", "uint8", container=Container.SEQUENCE)),
        ("int16[<=4] few", Field("few", "int16", container=Container.SEQUENCE, size=4)),
        ("string<=5[<=4] few", Field("few", "string", container=Container.SEQUENCE, size=4, string_bound=5)),
        ("float32[9] k", Field("k", "float32", container=Container.ARRAY, size=9)),
        (
            "geometry_msgs/Point[] ps",
            Field("ps", "geometry_msgs/Point", is_message=True, container=Container.SEQUENCE),
        ),
        ("time stamp", Field("stamp", "builtin_interfaces/msg/Time", is_message=True)),
        ("int32 from 5", Field("from", "int32")),
        ('string greeting "a # b"', Field("greeting", "string")),
        ("int32[] defaults [1, 2]", Field("defaults", "int32", container=Container.SEQUENCE)),
        ("@key int32 id", Field("id", "int32")),
    ],
)
def test_parse_msg_field_line(line: str, expected: Field) -> None:
    assert field_of(line) == expected


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("uint8 A=1", Constant("A", "uint8", 1)),
        ("int32 B = -5 # why", Constant("B", "int32", -5)),
        ("uint32 MASK=0xFF", Constant("MASK", "uint32", 255)),
        ("uint8 OLD=010", Constant("OLD", "uint8", 8)),
        ("float64 PI=3.5", Constant("PI", "float64", 3.5)),
        ("bool ON=True", Constant("ON", "bool", value=True)),
        ("bool OFF=0", Constant("OFF", "bool", value=False)),
        ("string TEXT=a # b ", Constant("TEXT", "string", "a # b")),
        ("string QUOTED=' a ' # b", Constant("QUOTED", "string", " a ")),
        ("float32 NOTHING=nan", Constant("NOTHING", "float32", pytest.approx(float("nan"), nan_ok=True))),
    ],
)
def test_parse_msg_constant_line(line: str, expected: Constant) -> None:
    assert parse_msg(line, "pkg/msg/Name").constants == (expected,)


@pytest.mark.parametrize(
    "line",
    [
        "int32", "int32 3x", "int32 x, y", "int32[-1] x", "int32[<=] x", "int32<=4 x", "uint8 A=", "uint8 A=one",
        "int32[99999999999] x", "bool B=perhaps", "Point P=1", "@optional int32 x", "int32 a\nint32 a",
    ],
)  # fmt: skip
def test_parse_msg_invalid_line_raises_with_location(line: str) -> None:
    with pytest.raises(BagError) as caught:
        parse_msg(f"# first\n{line}", "pkg/msg/Name", where="Name.msg")
    assert str(caught.value).startswith("Name.msg")


def test_parse_msg_ignores_carriage_returns_and_byte_order_mark() -> None:
    assert [f.name for f in parse_msg("\ufeffint32 a\r\n\r\n# c\r\nint32 b\r\n", "p/msg/N").fields] == [
        "a",
        "b",
    ]


def test_sections_have_names_and_lines() -> None:
    text = "Inner x\n" + "=" * 80 + "\nMSG: pkg/Inner\nfloat64 value\n" + "=" * 80 + "\nMSG: pkg/Empty\n"
    assert [(s.name, s.line) for s in sections(text)] == [("", 0), ("pkg/Inner", 3), ("pkg/Empty", 6)]
    assert list(read_types(text, "pkg/msg/Outer")) == ["pkg/msg/Outer", "pkg/msg/Inner", "pkg/msg/Empty"]


def test_read_types_error_in_later_section_has_line_in_text() -> None:
    text = "Inner x\n" + "=" * 80 + "\nMSG: pkg/Inner\nfloat64 value\nnonsense\n"
    with pytest.raises(BagError, match=r"^Outer\.msg:5: "):
        read_types(text, "pkg/msg/Outer", where="Outer.msg")


IDL = """
module pkg { module msg {
  module Name_Constants { const uint8 A = 3; };
  typedef double double__9[9];
  struct Name {
    @verbatim (language="comment", text="x") builtin_interfaces::msg::Time stamp;
    double__9 k;
    sequence<octet> blob;
    sequence<pkg::msg::Other, 4> few;
    wstring<8> wide;
  };
}; };
"""


def test_read_types_reads_several_idl_sections() -> None:
    other = "module pkg { module msg { struct Other { uint8 structure_needs_at_least_one_member; }; }; };"
    bar = "=" * 80
    types = read_types(
        f"{bar}\nIDL: pkg/msg/Name\n{IDL}\n{bar}\nIDL: pkg/msg/Other\n{other}\n", "pkg/msg/Name"
    )
    assert types["pkg/msg/Other"].fields == ()
    name = types["pkg/msg/Name"]
    assert name.constants == (Constant("A", "uint8", 3),)
    assert [(f.name, f.container, f.size) for f in name.fields] == [
        ("stamp", Container.SCALAR, 0),
        ("k", Container.ARRAY, 9),
        ("blob", Container.SEQUENCE, 0),
        ("few", Container.SEQUENCE, 4),
        ("wide", Container.SCALAR, 0),
    ]


@pytest.mark.parametrize(
    "text",
    [
        "module pkg { struct X { double ; }; };",
        "module pkg { const long A = 1 << 99999999999; };",
        "module pkg { struct X { " + "sequence<" * 5_000 + "double" + ">" * 5_000 + " x; }; };",
        "module pkg { struct X { double a[2][3]; }; };",
    ],
)
def test_read_idl_invalid_text_raises(text: str) -> None:
    with pytest.raises(BagError) as caught:
        read_types(text, "pkg/msg/X", where="X.idl")
    assert "\n" not in str(caught.value)


@given(st.text(max_size=200))
def test_read_types_any_text_returns_or_raises_bag_error(text: str) -> None:
    messages = list[str]()
    try:
        read_types(text, "pkg/msg/Name")
    except BagError as error:
        messages.append(str(error))
    assert "\n" not in "".join(messages)
