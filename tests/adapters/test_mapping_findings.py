"""Findings in adapter files: one per mistake, located at the offending text."""

from __future__ import annotations

import textwrap

import pytest

from mosaico_ingest.adapters.builtin import find_builtin
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
    """Return each finding with the text at its location."""
    try:
        spec = load_adapter(text, file="pack.yaml", adapters=find_builtin)
        pack = definition()
        findings = spec.check(pack, ros_shape(pack))
    except AdapterError as error:
        findings = error.findings
    lines = text.splitlines()
    actual = []
    for finding in findings:
        assert finding.span is not None
        line = lines[finding.span.line - 1]
        end = finding.span.end_column if finding.span.end_line == finding.span.line else len(line) + 1
        actual.append((finding, line[finding.span.column - 1 : end - 1]))
    return actual


@pytest.mark.parametrize(
    ("field", "rule", "under"),
    [
        ("count: statu", "unknown-field", "statu"),
        ("count: cells[].volts[0]", "unknown-field", "volts"),
        ("count: cells.voltage_mv", "operand-type", "voltage_mv"),
        ("count: status[]", "operand-type", "status[]"),
        ("count: status[0]", "operand-type", "status[0]"),
        ("count: 1 + big", "type-mismatch", "1 + big"),
        ("count: voltage_mv", "type-mismatch", "voltage_mv"),
        ("count: soc", "type-mismatch", "soc"),
        ("count: serial", "type-mismatch", "serial"),
        ("count: 3000000000", "type-mismatch", "3000000000"),
        ("count: cells[].voltage_mv", "type-mismatch", "cells[].voltage_mv"),
        ("count: header", "type-mismatch", "header"),
        ("count: status + serial", "operand-type", "serial"),
        ("count: -serial", "operand-type", "serial"),
        ("count: sqrt(serial)", "operand-type", "serial"),
        ("count: sqr(status)", "unknown-function", "sqr"),
        ("count: sqrt(status, 1)", "function-arguments", "sqrt(status, 1)"),
        ("count: 1 + cast(big)", "operand-type", "cast(big)"),
        ("count: cast(big, 'int33')", "operand-type", "'int33'"),
        ("count: 1 if status else 2", "operand-type", "status"),
        ("count: 1 if on else serial", "operand-type", "1 if on else serial"),
        ("count: status +", "expression-syntax", "+"),
        ('count: "(lambda: 1)"', "expression-syntax", "lambda: 1"),
        ("count: either(x, y)", "unknown-field", "y"),
        ("count: either(sqrt(serial), status)", "operand-type", "serial"),
        ("flag: status", "type-mismatch", "status"),
        ("flag: serial == null", "operand-type", "null"),
        ("flag: serial < 3", "operand-type", "serial < 3"),
        ("raw: null_if(nine, nine)", "operand-type", "nine"),
        ("flag: starts_with(serial, serial)", "operand-type", "serial"),
        ("name: replace(serial, '', 'a')", "operand-type", "''"),
        ("name: extract(serial, '(')", "operand-type", "'('"),
        ("name: yaw(self)", "operand-type", "self"),
        ("name: status", "type-mismatch", "status"),
        ("name: raw text", "expression-syntax", "t"),
        ("cells: status", "type-mismatch", "status"),
        ("cells: nine", "type-mismatch", "nine"),
        ("three: nine", "type-mismatch", "nine"),
        ("point: header", "type-mismatch", "header"),
        ("raw: nine", "type-mismatch", "nine"),
        ("countt: status", "unknown-column", "countt"),
        ("point: {fields: {xx: soc}}", "unknown-column", "xx"),
        ("point: {of: header, fields: {x: soc}}", "unknown-field", "soc"),
        ("point: {of: status, fields: {x: soc}}", "operand-type", "status"),
        ("point: {of: nope, fields: {x: soc}}", "unknown-field", "nope"),
        ("point: {of: cells, fields: {x: voltage_mv}}", "operand-type", "cells"),
        ("count: {fields: {x: soc}}", "type-mismatch", "fields"),
        ("count: {value: status, map: {1: 2, 300: 3}}", "type-mismatch", "300"),
        ("count: {value: status, map: {CHARGNG: 2}}", "unknown-field", "CHARGNG"),
        ("count: {value: status, map: {1: one}}", "unknown-field", "one"),
        ("count: {value: status, map: {1: \"'one'\"}}", "type-mismatch", "\"'one'\""),
        ("count: {value: status, map: {1: status}}", "operand-type", "status"),
        ("name: {value: status, map: {1: idle}}", "ambiguous-text", "idle"),
        ("name: {value: status, map: {1: CHARGING}}", "ambiguous-text", "CHARGING"),
        ("name: {value: status, map: {1: 'null'}}", "ambiguous-text", "'null'"),
        ("name: {value: status, map: {1: serial + 'a'}}", "operand-type", "serial + 'a'"),
        ("name: {value: status, map: {1: \"'a'\"}, else: 7}", "type-mismatch", "7"),
        ("name: {value: status, map: {1: 7}}", "type-mismatch", "7"),
        ("count: {value: status, map: {1: 2}, else: serial}", "type-mismatch", "serial"),
        ("count: {value: big, map: {1: 2}, else: keep}", "type-mismatch", "big"),
        ("count: {value: status, mapp: {1: 2}}", "unknown-key", "mapp"),
        ("point: {x: soc}", "unknown-key", "x"),
        ("count: {value: status, use: PoseAdapter, of: self}", "field-form", "count"),
        ("count: {of: header}", "field-form", "count"),
        ("count: {value: status, else: 3}", "field-form", "count"),
        ("count: {value: status, with: {x: 1}}", "field-form", "with"),
        ("count: {value: status, when: status}", "operand-type", "status"),
        ("point: {use: NoAdapter, of: header}", "unknown-adapter", "NoAdapter"),
        ("count: [1]", "wrong-value", "[1]"),
        ("count: {value: status, map: {1: [2]}}", "wrong-value", "[2]"),
    ],
)
def test_adapter_file_mistake_in_field_is_one_finding_at_the_value(field: str, rule: str, under: str) -> None:
    findings = findings_of(f"{FILE}  {field}\n")
    assert [(finding.rule, text) for finding, text in findings] == [(rule, under)], [
        str(f) for f, _ in findings
    ]


@pytest.mark.parametrize(
    ("field", "rule", "under", "hint"),
    [
        ('flag: "!on"', "expression-syntax", "!", "write `not`"),
        ("flag: on && on", "expression-syntax", "&&", "write `and`"),
        ("flag: on || on", "expression-syntax", "||", "write `or`"),
        ("flag: on & on", "operand-type", "on", "write `and`"),
        ('flag: "~on"', "operand-type", "on", "write `not`"),
        ("flag: status = 1", "expression-syntax", "=", "write `==` to compare"),
        ("flag: status === 1", "expression-syntax", "===", "write `==`"),
        ('count: "on ? 1 : 2"', "expression-syntax", "?", "write `a if condition else b`"),
        ("count: CHARG1NG", "unknown-field", "CHARG1NG", "did you mean 'CHARGING'?"),
        (
            "count: {value: status, map: {CHARG1NG: 2}}",
            "unknown-field",
            "CHARG1NG",
            "did you mean 'CHARGING'?",
        ),
        (
            "point: {use: PosAdapter, of: header}",
            "unknown-adapter",
            "PosAdapter",
            "did you mean 'PoseAdapter'?",
        ),
        ("count: list_max(cells[].voltage_mv)", "unknown-function", "list_max", "use greatest(x)"),
        ("count: avg(nine)", "unknown-function", "avg", "use mean(x)"),
        ("name: concat(serial, serial)", "unknown-function", "concat", "write a + b"),
        ("count: max(nine)", "function-arguments", "max(nine)", "use greatest(x)"),
        ("count: 0.5", "type-mismatch", "0.5", "write an integer"),
    ],
)
def test_adapter_file_mistake_with_known_remedy_suggests_it(
    field: str, rule: str, under: str, hint: str
) -> None:
    [(finding, text)] = findings_of(f"{FILE}  {field}\n")
    assert (finding.rule, text) == (rule, under)
    assert finding.help is not None
    assert finding.help.startswith(hint)


@pytest.mark.parametrize("body", ["ontology:\nfields: {data: data}\n", "ontology: Point3d\nfields:\n"])
def test_required_key_without_a_value_is_missing(body: str) -> None:
    [(finding, under)] = findings_of(f"version: 1\nadapter: A\nros_type: a_msgs/msg/B\n{body}")
    assert (finding.rule, under) == ("missing-key", "adapter")


def test_struct_written_as_plain_mapping_suggests_fields() -> None:
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
        ("acme_msgs/msg/Pack\n", "acme-msgs/Pack\n", "wrong-value", "acme-msgs/Pack"),
        ("ros_type:", "ros_typ:", "unknown-key", "ros_typ"),
        ("  volts: voltage_mv * 0.001\n", "  count: status\n", "missing-column", "fields"),
        ("  volts: voltage_mv * 0.001\n", "  volts: null\n", "missing-column", "null"),
        ("count: int32", "count: int33", "adapter-file", "int33"),
        ("tag: Pack", "tag: IMU", "adapter-file", "IMU"),
        ("count: int32", "count: {type: int32, fields: {a: int8}}", "adapter-file", "count"),
        ("count: int32", "timestamp_ns: int32", "adapter-file", "timestamp_ns"),
        ("    count: int32\n", "    count: {unit: m}\n", "adapter-file", "count"),
        ("    count: int32\n", "    count.er: int32\n", "adapter-file", "count.er"),
        ("fields:\n  volts", "schema_metadata: {a.b: soc}\nfields:\n  volts", "adapter-file", "a.b"),
        ("fields:\n  volts", "schema_metadata: {rate: soc +}\nfields:\n  volts", "expression-syntax", "+"),
        ("acme_msgs/msg/Pack", "acme_msgs/msg/Packet", "type-mismatch", "acme_msgs/msg/Packet"),
        ("version: 1", "version: 1\nversion: 1", "yaml-duplicate", "version"),
    ],
)
def test_adapter_file_mistake_is_one_finding_at_the_value(old: str, new: str, rule: str, under: str) -> None:
    assert old in FILE
    actual = findings_of(FILE.replace(old, new, 1))
    assert len(actual) == 1, [str(f) for f, _ in actual]
    if rule != "yaml-duplicate":
        assert (actual[0][0].rule, actual[0][1]) == (rule, under)


def test_ontology_unknown_suggests_nearest_tag() -> None:
    text = FILE[: FILE.index("ontology:")] + "ontology: BateryState\nfields: {}\n"
    [(finding, under)] = findings_of(text)
    assert under == "BateryState"
    assert finding.help is not None
    assert "BatteryState" in finding.help


def test_expression_with_two_unknown_fields_has_two_findings() -> None:
    actual = findings_of(f"{FILE}  count: nope + 2 * nada\n")
    assert [under for _, under in actual] == ["nope", "nada"]


def test_unknown_field_hint_lists_fields() -> None:
    [(finding, _)] = findings_of(f"{FILE}  count: statu\n")
    assert finding.help is not None
    assert finding.help.startswith("did you mean 'status'?")
    assert "voltage_mv" in finding.help


def test_finding_in_quoted_expression_points_at_the_name() -> None:
    [(_, under)] = findings_of(f'{FILE}  count: "1 + nope"\n')
    assert under == "nope"


def test_load_adapter_with_two_mistakes_raises_both_in_one_line() -> None:
    text = textwrap.dedent(FILE) + "  count: sqr(1)\n  flags: 1\n"
    with pytest.raises(AdapterError) as caught:
        load_adapter(text, file="pack.yaml")
    assert [finding.rule for finding in caught.value.findings] == ["unknown-function", "unknown-column"]
    assert "\n" not in str(caught.value)
    assert "pack.yaml:18:10" in str(caught.value)


def test_load_adapter_missing_file_raises_adapter_error(tmp_path: object) -> None:
    from pathlib import Path  # noqa: PLC0415 - the fixture is typed loosely

    with pytest.raises(AdapterError, match="cannot be read"):
        load_adapter(Path(str(tmp_path)) / "none.yaml")
