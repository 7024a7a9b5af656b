"""Mapping adapters: zero-copy fields, rejected rows and composition."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.adapters.adapter import (
    Adapted,
    Adapter,
    AdapterSpec,
    Envelope,
)
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec, load_adapter
from mosaico_ingest.adapters.standalone import message_row, run_tests
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.registry import ontology_type
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

PACK = """\
uint8 CHARGING=1
std_msgs/Header header
float64 volts
int64 count
uint8 status
int8 flag
string serial
Cell[] cells
float64[9] nine
float64[] any_length
uint8[] blob
geometry_msgs/Pose pose
geometry_msgs/PoseStamped[] poses
================================================================================
MSG: acme_msgs/Cell
uint16 voltage_mv
float64 temperature
builtin_interfaces/Time seen
"""

POSE = """\
version: 1
adapter: PoseAdapter
variants:
  geometry_msgs/msg/Pose: {}
  geometry_msgs/msg/PoseStamped: {of: pose, header: header}
ontology: Pose
fields: {position: position, orientation: orientation}
"""

EXPECTED: list[Adapter] = []
SPECS: list[AdapterSpec] = []


def adapters(name: str) -> MappingSpec | None:
    return load_adapter(POSE, file="pose.yaml") if name == "PoseAdapter" else None


def definition(msgtype: str = "acme_msgs/msg/Pack") -> Definition:
    embedded = Embedded("ros2msg", PACK) if msgtype.startswith("acme") else None
    return TypeResolver().resolve(msgtype, embedded, ros_version=2)


def spec_of(types: str, fields: str, **more: Any) -> MappingSpec:
    """Return an adapter with an inline ontology type; `types` and `fields` are lines of a mapping."""
    text = (
        "version: 1\nadapter: PackAdapter\nros_type: acme_msgs/msg/Pack\n"
        f"ontology:\n  tag: Pack\n  fields:\n{lines(types)}fields:\n{lines(fields)}"
    )
    return load_adapter(text, file="pack.yaml", adapters=adapters, **more)


def lines(mapping: str) -> str:
    return "".join(f"    {line}\n" for line in mapping.split("\n"))


def bound(spec: MappingSpec) -> MappingAdapter:
    pack = definition(spec.ros_types[0])
    return spec.bind(pack, ros_shape(pack))


def rows_of(*given: dict[str, Any]) -> Any:
    shape = ros_shape(definition())
    return pa.array([message_row(row, shape)[0] for row in given], shape)


def adapt(spec: MappingSpec, rows: Any) -> Adapted:
    return bound(spec).adapt(rows, Envelope("/pack", "acme_msgs/msg/Pack", np.arange(len(rows))))


def values(types: str, fields: str, *given: dict[str, Any]) -> list[dict[str, Any]]:
    adapted = adapt(spec_of(types, fields), rows_of(*given))
    assert adapted.failures == ()
    adapted.rows.validate(full=True)
    return adapted.rows.to_pylist()


def reasons(types: str, fields: str, *given: dict[str, Any]) -> dict[int, tuple[str, str]]:
    adapted = adapt(spec_of(types, fields), rows_of(*given))
    adapted.rows.validate(full=True)
    assert sorted([*adapted.index.tolist(), *(f.row for f in adapted.failures)]) == list(range(len(given)))
    return {failure.row: (failure.rule, failure.reason) for failure in adapted.failures}


def addresses(array: Any) -> set[int]:
    return {buffer.address for buffer in array.buffers() if buffer is not None and buffer.size}


def test_mapping_spec_and_adapter_implement_protocols() -> None:
    spec = spec_of("a: float64", "a: volts")
    EXPECTED.append(bound(spec))  # pyright and a reader see the protocol satisfied
    SPECS.append(spec)
    assert (spec.name, spec.ros_types, spec.default) == ("PackAdapter", ("acme_msgs/msg/Pack",), True)


def test_adapt_keeps_order_and_returns_exact_type() -> None:
    spec = spec_of("a: {type: float64, nullable: false}\nb: float32", "a: volts")
    adapted = adapt(spec, rows_of({"volts": 1.0}, {"volts": 2.0}, {"volts": 3.0}))
    assert adapted.rows.type == spec.ontology.struct
    assert adapted.rows.to_pylist() == [{"a": v, "b": None} for v in (1.0, 2.0, 3.0)]
    assert adapted.index.tolist() == [0, 1, 2]


def test_adapt_empty_batch_returns_empty_batch() -> None:
    spec = spec_of(
        "a: float32\nc: list[float32]\np: Pose",
        "a: cast(volts)\nc: cells[].voltage_mv\np: {use: PoseAdapter, of: pose}",
    )
    adapted = adapt(spec, rows_of())
    assert (len(adapted.rows), adapted.rows.type, adapted.failures) == (0, spec.ontology.struct, ())


@pytest.mark.parametrize(
    ("types", "fields", "of"),
    [
        ("a: float64", "a: volts", lambda rows: rows.field("volts")),
        ("a: string", "a: serial", lambda rows: rows.field("serial")),
        ("a: binary", "a: blob", lambda rows: rows.field("blob")),
        ("a: 'list[float64]'", "a: any_length", lambda rows: rows.field("any_length").values),
        ("a: 'list[float64]'", "a: nine", lambda rows: rows.field("nine").values),
        ("a: 'list[float64, 9]'", "a: 'nine[]'", lambda rows: rows.field("nine").values),
        ("a: Point3d", "a: pose.position", lambda rows: rows.field("pose").field("position").field("x")),
        ("a: Header", "a: header", lambda rows: rows.field("header").field("frame_id")),
        ("a: Header", "a: header", lambda rows: rows.field("header").field("stamp").field("sec")),
        ("a: 'list[Time]'", "a: 'cells[].seen'", lambda rows: rows.field("cells").values.field("seen").field("sec")),
        ("a: 'list[uint16]'", "a: 'cells[].voltage_mv'", lambda rows: rows.field("cells").values.field("voltage_mv")),
        ("a: Pose", "a: {use: PoseAdapter, of: pose}", lambda rows: rows.field("pose").field("position").field("z")),
        ("a: 'list[Pose]'", "a: {use: PoseAdapter, of: 'poses[]'}", lambda rows: rows.field("poses").values.field("pose").field("position").field("x")),
    ],
)  # fmt: skip
def test_adapt_moved_fields_share_memory(types: str, fields: str, of: Callable[[Any], Any]) -> None:
    messages = {
        "header": {"frame_id": "f"},
        "serial": "a",
        "blob": [1, 2],
        "any_length": [1.0],
        "cells": [{"voltage_mv": 1}],
        "poses": [{"header": {"frame_id": "p"}}],
    }
    rows = rows_of(messages, messages)
    adapted = adapt(spec_of(types, fields), rows)
    assert addresses(of(rows)) <= addresses(adapted.rows.field("a"))


def test_adapt_sliced_batch_returns_slice() -> None:
    messages = [
        {"volts": float(k), "cells": [{"voltage_mv": k}] * k, "nine": [float(k)] * 9} for k in range(6)
    ]
    spec = spec_of(
        "a: float64\nc: list[float32]\nn: list[float64]\nz: 'list[float64, 9]'",
        "a: volts\nc: 'cells[].voltage_mv * 2'\nn: nine\nz: 'nine[]'",
    )
    whole = adapt(spec, rows_of(*messages)).rows.to_pylist()
    assert adapt(spec, rows_of(*messages).slice(2, 3)).rows.to_pylist() == whole[2:5]


@pytest.mark.parametrize(
    ("types", "fields", "bad", "rule", "says"),
    [
        ("a: int8", "a: cast(count)", {"count": 128}, "out-of-range", "a: `cast(count)`: 128 does not fit int8"),
        ("a: float32", "a: cast(volts)", {"volts": 1e300}, "out-of-range", "1e+300 does not fit float32"),
        ("a: int32", "a: cast(volts)", {"volts": 0.5}, "out-of-range", "0.5 does not fit int32"),
        ("a: int32", "a: cast(volts)", {"volts": float("nan")}, "out-of-range", "nan does not fit int32"),
        ("a: bool", "a: cast(status)", {"status": 2}, "out-of-range", "2 does not fit bool"),
        ("a: int64", "a: count * count", {"count": 2**40}, "overflow", "1099511627776 * 1099511627776"),
        ("a: int64", "a: 1 // flag", {"flag": 0}, "division", "1 // 0 has no result"),
        ("a: int64", "a: status % flag", {"flag": 0}, "division", "1 % 0 has no result"),
        ("a: float64", "a: number(serial)", {"serial": "x1"}, "number-syntax", "'x1'"),
        ("a: int32", "a: {value: status, map: {1: 5, CHARGING: 5}}", {"status": 9}, "unmapped", "a: `status`: 9 is not in the map"),
        ("a: 'list[float64, 2]'", "a: any_length", {"any_length": [1.0]}, "list-length", "the list has 1 elements, not 2"),
        ("a: 'list[float64]'", "a: 'any_length[] + nine[]'", {"any_length": [1.0]}, "list-length", "lists of 9 and 1 elements"),
        ("a: 'list[uint8]'", "a: 'cast(cells[].voltage_mv)'", {"cells": [{"voltage_mv": 1}, {"voltage_mv": 300}]}, "out-of-range", "300 does not fit uint8"),
        ("a: Header", "a: header", {"header": {"stamp": {"nanosec": 2 * 10**9}}}, "nanosec", "nanosec is 2000000000"),
        ("a: 'list[Time]'", "a: 'cells[].seen'", {"cells": [{"seen": {"nanosec": 10**9}}]}, "nanosec", "nanosec is 1000000000"),
        ("a: {type: string, nullable: false}", "a: if_else(serial == '', null, serial)", {"serial": ""}, "null", "a: null"),
        ("a: {type: float64, nullable: false}", "a: 'any_length[0]'", {"any_length": []}, "null", "null"),
        ("a: 'list[Pose]'", "a: {use: PoseAdapter, of: 'poses[]'}", {"poses": [{}, {"header": {"stamp": {"nanosec": 10**9}}}]}, "nanosec", "PoseAdapter: header: nanosec is"),
        ("a: {fields: {b: int8}}", "a: {of: pose.position, fields: {b: cast(x)}}", {"pose": {"position": {"x": 0.5}}}, "out-of-range", "a.b: `cast(x)`: 0.5 does not fit"),
    ],
)  # fmt: skip
def test_adapt_invalid_row_is_rejected_with_rule_and_value(
    types: str, fields: str, bad: dict[str, Any], rule: str, says: str
) -> None:
    good = {"flag": 1, "serial": "1", "status": 1, "any_length": [1.0] * 9} if "length[] +" in fields else {
        "flag": 1, "serial": "1", "status": 1, "any_length": [1.0, 2.0]
    }  # fmt: skip
    actual = reasons(types, fields, good, {**good, **bad}, good)
    assert actual.keys() == {1}
    assert actual[1][0] == rule
    assert says in actual[1][1]


def test_adapt_rows_with_different_mistakes_are_all_rejected() -> None:
    messages = [
        {"count": 1, "flag": 1},
        {"count": 300, "flag": 1},
        {"count": 1},
        {"count": 300},
        {"count": 2, "flag": 2},
    ]
    spec = spec_of("a: int8\nb: int64", "a: cast(count)\nb: 8 // flag")
    adapted = adapt(spec, rows_of(*messages))
    assert [failure.row for failure in adapted.failures] == [1, 2, 3]
    assert adapted.index.tolist() == [0, 4]
    assert adapted.rows.to_pylist() == [{"a": 1, "b": 8}, {"a": 2, "b": 4}]


def test_adapt_branch_not_taken_rejects_no_row() -> None:
    assert values("a: int64", "a: 8 // flag if flag != 0 else -1", {"flag": 0}, {"flag": 4}) == [
        {"a": -1},
        {"a": 2},
    ]
    fields = "a: 'cast(cells[].voltage_mv, \"uint8\") if cells[].voltage_mv < 256 else 255'"
    assert values("a: list[uint8]", fields, {"cells": [{"voltage_mv": 7}, {"voltage_mv": 999}]}) == [
        {"a": [7, 255]}
    ]
    fields = "a: {use: PoseAdapter, of: 'poses[0]', when: len(serial) > 0}"
    bad = {"poses": [{"header": {"stamp": {"nanosec": 10**9}}}]}
    assert values("a: Pose", fields, bad) == [{"a": None}]
    assert reasons("a: Pose", fields, {**bad, "serial": "x"}).keys() == {0}


def test_adapt_constant_fills_every_row() -> None:
    types = "a: bool\nb: float32\nc: string\nd: 'list[int8, 2]'\ne: int32"
    assert (
        values(types, "a: true\nb: 0.5\nc: \"'raw'\"\nd: '[1, 2]'\ne: CHARGING", {}, {})
        == [{"a": True, "b": 0.5, "c": "raw", "d": [1, 2], "e": 1}] * 2
    )


def test_adapt_map_replaces_values_and_constants() -> None:
    messages = [{"status": 0}, {"status": 1}, {"status": 7}]
    assert [
        r["a"]
        for r in values(
            "a: string",
            "a: {value: status, map: {0: \"'idle'\", CHARGING: \"'busy'\"}, else: \"'?'\"}",
            *messages,
        )
    ] == ["idle", "busy", "?"]
    assert [r["a"] for r in values("a: uint8", "a: {value: status, map: {0: 9}, else: keep}", *messages)] == [
        9,
        1,
        7,
    ]
    assert [r["a"] for r in values("a: uint8", "a: {value: status, map: {0: 9}, else: null}", *messages)] == [
        9,
        None,
        None,
    ]
    assert values(
        "a: list[uint8]",
        "a: {value: 'cells[].voltage_mv', map: {1: 2}, else: 0}",
        {"cells": [{"voltage_mv": 1}, {}]},
    ) == [{"a": [2, 0]}]


@pytest.mark.parametrize("types", ["string", "uint8", "float32"])
@pytest.mark.parametrize("text", ["\"'a'\"", "CHARGING", "(CHARGING)", "7", "null", "true", "1.5", "'\"'"])
def test_adapt_map_and_else_give_text_the_same_meaning(types: str, text: str) -> None:
    def outcome(field: str, message: dict[str, Any]) -> object:
        try:
            return values(f"a: {types}", f"a: {field}", message)
        except AdapterError:
            return "no value"

    in_map = outcome(f"{{value: status, map: {{1: {text}}}}}", {"status": 1})
    in_else = outcome(f"{{value: status, map: {{5: null}}, else: {text}}}", {"status": 1})
    assert in_map == in_else


@pytest.mark.parametrize(("text", "expected"), [("CHARGING", 1), ("(CHARGING)", 1), ("9", 9), ("null", None)])
def test_adapt_map_value_can_be_a_constant(text: str, expected: int | None) -> None:
    assert values("a: uint8", f"a: {{value: status, map: {{3: {text}}}}}", {"status": 3}) == [{"a": expected}]


def test_adapt_with_and_when_change_struct() -> None:
    messages = {"pose": {"position": {"x": 1.0}}, "nine": [1.0] * 9}
    fields = "p: {value: pose.position, with: {covariance: nine, covariance_type: status}, when: volts > 0}"
    first, second = values("p: Point3d", fields, {**messages, "volts": 1.0, "status": 3}, messages)
    assert first["p"] == {
        "header": None,
        "covariance": [1.0] * 9,
        "covariance_type": 3,
        "x": 1.0,
        "y": 0.0,
        "z": 0.0,
    }
    assert second["p"] is None


def test_adapt_with_reads_names_outside_of() -> None:
    fields = "p: {of: 'cells[]', fields: {x: temperature}, with: {y: volts}}"
    [row] = values(
        "p: list[Point2d]", fields, {"volts": 5.0, "cells": [{"temperature": 1.0}, {"temperature": 2.0}]}
    )
    assert [(p["x"], p["y"]) for p in row["p"]] == [(1.0, 5.0), (2.0, 5.0)]


def test_adapt_variants_read_payload_from_of() -> None:
    spec = load_adapter(POSE, file="pose.yaml")
    stamped = definition("geometry_msgs/msg/PoseStamped")
    shape = ros_shape(stamped)
    row, _ = message_row({"header": {"frame_id": "map"}, "pose": {"position": {"x": 1.0}}}, shape)
    adapted = spec.bind(stamped, shape).adapt(pa.array([row], shape), Envelope("", "", np.zeros(1, np.int64)))
    [pose] = adapted.rows.to_pylist()
    assert (pose["header"]["frame_id"], pose["position"]["x"]) == ("map", 1.0)
    assert adapted.rows.type == ontology_type("Pose").struct


def test_bind_adapter_cycle_raises() -> None:
    text = POSE.replace(
        "{position: position, orientation: orientation}",
        "{position: position, orientation: {use: LoopAdapter, of: self}}",
    )
    loop = load_adapter(text.replace("PoseAdapter", "LoopAdapter"), file="loop.yaml", adapters=looping)
    pose = definition("geometry_msgs/msg/Pose")
    with pytest.raises(AdapterError, match="LoopAdapter → LoopAdapter"):
        loop.bind(pose, ros_shape(pose))


def looping(name: str) -> MappingSpec:
    text = POSE.replace(
        "{position: position, orientation: orientation}",
        "{position: position, orientation: {use: LoopAdapter, of: self}}",
    )
    return load_adapter(text.replace("PoseAdapter", name), file="loop.yaml", adapters=looping)


def test_mapping_spec_pickles() -> None:
    spec = spec_of("a: Pose", "a: {use: PoseAdapter, of: pose}")
    again = pickle.loads(pickle.dumps(spec))  # noqa: S301 - our own bytes
    assert again.ontology == spec.ontology
    assert len(adapt(again, rows_of({})).rows) == 1


def test_topic_metadata_reads_first_row() -> None:
    text = (
        "version: 1\nadapter: A\nros_type: acme_msgs/msg/Pack\nontology: {tag: P, fields: {a: float64}}\n"
        "fields: {a: volts}\nschema_metadata: {rate: volts * 2, kind: \"'pack'\", channels: 3, cells: 'cells[].voltage_mv'}\n"
    )
    adapter = bound(load_adapter(text, file="a.yaml"))
    first = rows_of({"volts": 2.0, "cells": [{"voltage_mv": 7}]})[0]
    assert adapter.topic_metadata(first) == {"rate": 4.0, "kind": "pack", "channels": 3, "cells": [7]}
    assert adapter.topic_metadata(None) == {}


def test_adapt_keyword_field_is_read_through_self() -> None:
    text = "version: 1\nadapter: A\nros_type: a/msg/B\nontology: {tag: P, fields: {a: int32}}\nfields:\n  a: self['from']\n"
    keyword = TypeResolver().resolve("a/msg/B", Embedded("ros2msg", "int32 from"), ros_version=2)
    adapter = load_adapter(text, file="a.yaml").bind(keyword, ros_shape(keyword))
    rows: Any = pa.array([{"from": 7}], ros_shape(keyword))
    assert adapter.adapt(rows, Envelope("", "", np.zeros(1, np.int64))).rows.to_pylist() == [{"a": 7}]


CASES = """\
version: 1
adapter: PackAdapter
ros_type: acme_msgs/msg/Pack
ontology: {tag: Pack, fields: {a: float32, b: 'list[float64]'}}
fields: {a: cast(volts), b: any_length}
definition: |
  float64 volts
  float64[] any_length
tests:
"""


@pytest.mark.parametrize(
    ("case", "problem"),
    [
        ("given: {volts: 0.1}, expect: {a: 0.1}", None),
        ("given: {}, expect: {a: 0, b: []}", None),
        ("given: {volts: .nan}, expect: {a: .nan}", None),
        ("given: {volts: 1e300}, rejects: does not fit", None),
        ("given: {volts: 1}, expect: {a: 2}", "a: expected 2, got 1.0"),
        ("given: {volts: 1}, expect: {a: null}", "a: expected None, got 1.0"),
        ("given: {volts: 1}, expect: {aa: 2}", "field aa; did you mean 'a'?"),
        ("given: {volt: 1}, expect: {a: 2}", "field volt; did you mean 'volts'?"),
        ("given: {any_length: [1, 2]}, expect: {b: [1]}", "b: expected 1 elements, got 2"),
        ("given: {any_length: [1, 2]}, expect: {b: [1, 3]}", "b[1]: expected 3, got 2.0"),
        ("given: {any_length: 1}, expect: {b: [1]}", "any_length must be a list, not 1"),
        ("given: {volts: text}, expect: {a: 1}", "given does not fit"),
        ("given: {volts: 1}, rejects: anything", "the row is accepted"),
        ("given: {volts: 1e300}, rejects: nanosec", "does not contain 'nanosec'"),
        ("given: {volts: 1e300}, expect: {a: 1}", "the row is rejected: a: `cast(volts)`"),
        ("given: {volts: 1}", "neither expect nor rejects"),
        ("given: {bag: x.mcap, topic: /a}, expect: {a: 1}", "recorded messages cannot be read here"),
        ("given: {}, ros_type: acme_msgs/msg/Nope, expect: {a: 0}", "`definition`"),
    ],
)
def test_run_tests_reports_differences(case: str, problem: str | None) -> None:
    [outcome] = run_tests(load_adapter(f"{CASES}  - {{name: it, {case}}}\n", file="a.yaml"), TypeResolver())
    assert outcome.line == 10
    assert outcome.passed == (problem is None)
    assert problem is None or problem in outcome.problems[0]


def test_run_tests_reads_recorded_message() -> None:
    spec = load_adapter(
        CASES + "  - {name: it, given: {bag: x.mcap, topic: /a, index: 2}, expect: {a: 5}}\n", file="a.yaml"
    )
    pack = TypeResolver().resolve(
        "acme_msgs/msg/Pack", Embedded("ros2msg", spec.model.definition or ""), ros_version=2
    )
    rows: Any = pa.array([{"volts": 5.0, "any_length": []}], ros_shape(pack))
    envelope = Envelope("/a", pack.root, np.zeros(1, np.int64))
    seen: list[Any] = []
    [outcome] = run_tests(
        spec, TypeResolver(), recorded=lambda what: (seen.append(what), (pack, rows, envelope))[1]
    )
    assert outcome.passed
    assert (seen[0].bag, seen[0].topic, seen[0].index) == ("x.mcap", "/a", 2)
