"""Every kind of mistake in an adapter file: one finding each, at its place."""

from __future__ import annotations

import textwrap

import pytest

from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import Finding
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

PACK = """\
uint8 CHARGING=1
std_msgs/Header header
uint32 voltage_mv
int64 big
float64 precise
float32 soc
bool on
Cell[] cells
uint8 status
string serial
float64[9] nine
uint8[] blob
================================================================================
MSG: acme_msgs/Cell
uint16 voltage_mv
string name
"""

FILE = """\
version: 1
adapter: PackAdapter
ros_type: acme_msgs/msg/Pack
ontology:
  tag: Pack
  fields:
    header: Header
    volts: {type: float32, nullable: false}
    count: int32
    flag: bool
    name: string
    cells: list[float32]
    three: list[float64, 3]
    point: Point3d
    raw: binary
fields:
  volts: voltage_mv * 0.001
"""


def definition() -> Definition:
    return TypeResolver().resolve("acme_msgs/msg/Pack", Embedded("ros2msg", PACK), ros_version=2)


def findings_of(text: str) -> list[tuple[Finding, str]]:
    """Return every finding with the text it points at."""
    try:
        spec = load_adapter(text, file="pack.yaml")
        pack = definition()
        findings = spec.check(pack, ros_shape(pack))
    except AdapterError as error:
        findings = error.findings
    lines = text.splitlines()
    found = []
    for finding in findings:
        assert finding.span is not None
        line = lines[finding.span.line - 1]
        end = finding.span.end_column if finding.span.end_line == finding.span.line else len(line) + 1
        found.append((finding, line[finding.span.column - 1 : end - 1]))
    return found


@pytest.mark.parametrize(
    ("field", "rule", "under", "message"),
    [
        ("count: statu", "unknown-field", "statu", "no field 'statu'"),
        ("count: cells[].volts[0]", "unknown-field", "volts", "no field 'volts' in `cells[]`"),
        ("count: cells.voltage_mv", "operand-type", "voltage_mv", "it has no fields"),
        ("count: status[]", "operand-type", "status[]", "not a list"),
        ("count: status[0]", "operand-type", "status[0]", "not a list"),
        ("count: 1 + big", "type-mismatch", "1 + big", "may not fit int32"),
        ("count: voltage_mv", "type-mismatch", "voltage_mv", "uint32 may not fit int32"),
        ("count: soc", "type-mismatch", "soc", "float32 may not fit int32"),
        ("count: serial", "type-mismatch", "serial", "string for int32"),
        ("count: 3000000000", "type-mismatch", "3000000000", "does not fit int32"),
        ("count: cells[].voltage_mv", "type-mismatch", "cells[].voltage_mv", "a list for int32"),
        ("count: header", "type-mismatch", "header", "std_msgs/msg/Header for int32"),
        ("count: status + serial", "operand-type", "serial", "two numbers or two texts"),
        ("count: -serial", "operand-type", "serial", "takes a number"),
        ("count: sqrt(serial)", "operand-type", "serial", "takes a number here"),
        ("count: sqr(status)", "unknown-function", "sqr", "no function 'sqr'"),
        ("count: sqrt(status, 1)", "function-arguments", "sqrt(status, 1)", "takes 1 argument"),
        ("count: 1 + cast(big)", "operand-type", "cast(big)", "needs the type"),
        ("count: cast(big, 'int33')", "operand-type", "'int33'", "cast makes"),
        ("count: 1 if status else 2", "operand-type", "status", "a condition is true or false"),
        ("count: 1 if on else serial", "operand-type", "1 if on else serial", "no common type"),
        ("count: status +", "expression-syntax", "+", "not an expression"),
        ('count: "(lambda: 1)"', "expression-syntax", "lambda: 1", "not part of the language"),
        ("count: either(x, y)", "unknown-field", "y", "no field 'y'"),
        ("count: either(sqrt(serial), status)", "operand-type", "serial", "takes a number"),
        ("flag: status", "type-mismatch", "status", "uint8 for bool"),
        ("flag: serial == null", "operand-type", "null", "always null"),
        ("flag: serial < 3", "operand-type", "serial < 3", "cannot be compared"),
        ("flag: starts_with(serial, serial)", "operand-type", "serial", "a text in quotes"),
        ("name: replace(serial, '', 'a')", "operand-type", "''", "the text to look for is empty"),
        ("name: extract(serial, '(')", "operand-type", "'('", "not a regular expression"),
        ("name: yaw(self)", "operand-type", "self", "takes a quaternion"),
        ("name: status", "type-mismatch", "status", "uint8 for string"),
        ("name: raw text", "expression-syntax", "t", "not an expression"),
        ("cells: status", "type-mismatch", "status", "uint8 for list[float32]"),
        ("cells: nine", "type-mismatch", "nine", "float64 may not fit float32"),
        ("three: nine", "type-mismatch", "nine", "a list of 9 for one of 3"),
        ("point: header", "type-mismatch", "header", "which {header, covariance"),
        ("raw: nine", "type-mismatch", "nine", "for binary"),
        ("countt: status", "unknown-column", "countt", "has no field 'countt'"),
        ("point: {fields: {xx: soc}}", "unknown-column", "xx", "point has no field 'xx'"),
        (
            "point: {of: header, fields: {x: soc}}",
            "unknown-field",
            "soc",
            "no field 'soc' in std_msgs/msg/Header",
        ),
        ("point: {of: status, fields: {x: soc}}", "operand-type", "status", "not a message"),
        ("point: {of: nope, fields: {x: soc}}", "unknown-field", "nope", "no field 'nope'"),
        ("point: {of: cells, fields: {x: voltage_mv}}", "operand-type", "cells", "not a message"),
        ("count: {fields: {x: soc}}", "type-mismatch", "fields", "it has no fields"),
        ("count: {value: status, map: {1: 2, 300: 3}}", "type-mismatch", "300", "is never 300"),
        ("count: {value: status, map: {CHARGNG: 2}}", "unknown-field", "CHARGNG", "no constant 'CHARGNG'"),
        ("count: {value: status, map: {1: one}}", "type-mismatch", "one", "string for int32"),
        ("count: {value: status, map: {1: 2}, else: serial}", "type-mismatch", "serial", "string for int32"),
        ("count: {value: big, map: {1: 2}, else: keep}", "type-mismatch", "big", "may not fit"),
        ("count: {value: status, mapp: {1: 2}}", "unknown-key", "mapp", "unknown key 'mapp'"),
        ("point: {x: soc}", "unknown-key", "x", "unknown key 'x' in fields.point"),
        (
            "count: {value: status, use: PoseAdapter, of: self}",
            "field-form",
            "count",
            "value and use are given",
        ),
        ("count: {of: header}", "field-form", "count", "nothing says where"),
        ("count: {value: status, else: 3}", "field-form", "count", "`else` goes with map"),
        ("count: {value: status, with: {x: 1}}", "field-form", "with", "`with` sets fields of a struct"),
        ("count: {value: status, when: status}", "operand-type", "status", "`when` is true or false"),
        ("point: {use: NoAdapter, of: header}", "unknown-adapter", "use", "no adapter 'NoAdapter'"),
        ("count: [1]", "wrong-value", "[1]", "it is an expression, a number"),
        ("count: {value: status, map: {1: [2]}}", "wrong-value", "[2]", "it is an expression, a number"),
    ],
)
def test_a_mistake_in_a_field_is_one_finding_at_its_place(
    field: str, rule: str, under: str, message: str
) -> None:
    found = findings_of(f"{FILE}  {field}\n")
    assert [(finding.rule, text) for finding, text in found] == [(rule, under)], [str(f) for f, _ in found]
    assert message in found[0][0].message


def test_whoever_writes_a_struct_as_a_plain_mapping_is_told_how() -> None:
    [(finding, _)] = findings_of(f"{FILE}  point: {{x: soc}}\n")
    assert finding.help is not None
    assert finding.help.startswith("a struct is written {fields: {x: …}}; ")


@pytest.mark.parametrize(
    ("old", "new", "rule", "under"),
    [
        ("version: 1\n", "version: 2\n", "wrong-value", "2"),
        ("adapter: PackAdapter\n", "", "missing-key", "v"),
        ("ros_type: acme_msgs/msg/Pack\n", "", "adapter-file", "adapter"),
        ("acme_msgs/msg/Pack\n", "acme_msgs/msg/Pack\nvariants: {a/b: {}}\n", "adapter-file", "adapter"),
        ("acme_msgs/msg/Pack\n", "Pack\n", "wrong-value", "Pack"),
        ("ros_type:", "ros_typ:", "unknown-key", "ros_typ"),
        ("  volts: voltage_mv * 0.001\n", "  count: status\n", "missing-column", "fields"),
        ("  volts: voltage_mv * 0.001\n", "  volts: null\n", "missing-column", "volts"),
        ("count: int32", "count: int33", "adapter-file", "count"),
        ("tag: Pack", "tag: IMU", "adapter-file", "tag"),
        ("count: int32", "count: {type: int32, fields: {a: int8}}", "adapter-file", "count"),
        ("count: int32", "timestamp_ns: int32", "adapter-file", "timestamp_ns"),
        ("    count: int32\n", "    count: {unit: m}\n", "adapter-file", "count"),
        ("    count: int32\n", "    count.er: int32\n", "adapter-file", "count.er"),
        ("fields:\n  volts", "schema_metadata: {a.b: soc}\nfields:\n  volts", "adapter-file", "a.b"),
        ("fields:\n  volts", "schema_metadata: {rate: soc +}\nfields:\n  volts", "expression-syntax", "+"),
        ("acme_msgs/msg/Pack", "acme_msgs/msg/Packet", "type-mismatch", "ros_type"),
        ("version: 1", "version: 1\nversion: 1", "yaml-duplicate", "version"),
    ],
)
def test_a_mistake_in_the_file_is_one_finding(old: str, new: str, rule: str, under: str) -> None:
    assert old in FILE
    found = findings_of(FILE.replace(old, new, 1))
    assert len(found) == 1, [str(f) for f, _ in found]
    if rule != "yaml-duplicate":
        assert (found[0][0].rule, found[0][1]) == (rule, under)


def test_an_unknown_tag_names_the_nearest() -> None:
    text = FILE[: FILE.index("ontology:")] + "ontology: BateryState\nfields: {}\n"
    [(finding, under)] = findings_of(text)
    assert under == "ontology"
    assert finding.help is not None
    assert "BatteryState" in finding.help


def test_two_mistakes_in_one_expression_are_two_findings() -> None:
    found = findings_of(f"{FILE}  count: nope + 2 * nada\n")
    assert [under for _, under in found] == ["nope", "nada"]


def test_an_unknown_field_lists_the_fields_there_are() -> None:
    [(finding, _)] = findings_of(f"{FILE}  count: statu\n")
    assert finding.help is not None
    assert finding.help.startswith("did you mean 'status'?")
    assert "voltage_mv" in finding.help


def test_places_inside_quoted_text_are_right() -> None:
    [(_, under)] = findings_of(f'{FILE}  count: "1 + nope"\n')
    assert under == "nope"


def test_all_findings_come_at_once_and_the_error_is_one_line() -> None:
    text = textwrap.dedent(FILE) + "  count: sqr(1)\n  flags: 1\n"
    with pytest.raises(AdapterError) as caught:
        load_adapter(text, file="pack.yaml")
    assert [finding.rule for finding in caught.value.findings] == ["unknown-function", "unknown-column"]
    assert "\n" not in str(caught.value)
    assert "pack.yaml:18:10" in str(caught.value)


def test_a_file_that_cannot_be_read_says_so(tmp_path: object) -> None:
    from pathlib import Path  # noqa: PLC0415 - the fixture is typed loosely

    with pytest.raises(AdapterError, match="cannot be read"):
        load_adapter(Path(str(tmp_path)) / "none.yaml")
