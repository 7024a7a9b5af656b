"""Adapters written in Python: the contracts of the base class, by message and by columns."""

from __future__ import annotations

import inspect
import json
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.adapters import python as base
from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.bridge import adapter_spec, load_adapter_reference
from mosaico_ingest.adapters.python import (
    PythonAdapter,
    PythonAdapterSpec,
    ROSAdapterBase,
    ontology_of,
    register_default_adapter,
    registered_adapters,
)
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.model import Message, Serializable
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition


class Speed(Serializable):
    """The ontology class of the tests."""

    value: float
    name: str | None = None


class SpeedAdapter(ROSAdapterBase[Speed]):
    ros_msgtype = "std_msgs/Float64"
    __mosaico_ontology_type__ = Speed

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any], **kwargs: Any) -> Speed:
        if ros_data["data"] < 0:
            raise ValueError(f"speed is {ros_data['data']}")
        return Speed(value=ros_data["data"], **kwargs)


def line_of(method: Callable[..., Any], text: str) -> int:
    """Return the number of the first line of a method that contains a text."""
    lines, first = inspect.getsourcelines(method)
    return first + next(at for at, line in enumerate(lines) if text in line)


@pytest.fixture
def floats(define: Callable[..., Definition], adapt: Callable[..., Adapted]) -> Callable[..., Adapted]:
    def run(adapter: type[Any], *values: float) -> Adapted:
        return adapt(
            PythonAdapterSpec(adapter), define("std_msgs/msg/Float64"), [{"data": v} for v in values]
        )

    return run


@pytest.fixture(autouse=True)
def _nothing_stays_registered() -> Iterator[None]:
    before = dict(base._registered)
    yield
    base._registered.clear()
    base._registered.update(before)


def test_python_adapter_messages_become_rows_in_order(floats: Callable[..., Adapted]) -> None:
    adapted = floats(SpeedAdapter, *range(600))
    assert adapted.rows.field("value").to_pylist() == list(range(600))
    assert adapted.index.tolist() == list(range(600))
    assert adapted.rows.type == Speed.ontology_type().struct
    assert adapted.log_times is None


def test_python_adapter_empty_batch_returns_no_rows(floats: Callable[..., Adapted]) -> None:
    adapted = floats(SpeedAdapter)
    assert len(adapted.rows) == 0
    assert adapted.rows.type == Speed.ontology_type().struct


def test_python_adapter_exception_rejects_only_its_row(floats: Callable[..., Adapted]) -> None:
    adapted = floats(SpeedAdapter, 1, -2, 3)
    assert adapted.index.tolist() == [0, 2]
    (failure,) = adapted.failures
    assert (failure.row, failure.rule) == (1, "adapter-rejected")
    line = line_of(SpeedAdapter.from_dict, "raise ValueError")
    assert failure.reason == (
        f"SpeedAdapter: ValueError: speed is -2.0 ({__file__}:{line}, message 1, log time 1 ns; fields: data)"
    )


def test_python_adapter_exception_in_library_names_line_of_adapter(floats: Callable[..., Adapted]) -> None:
    class Parsing(SpeedAdapter):
        @classmethod
        def from_dict(cls, ros_data: dict[str, Any], **_: Any) -> Speed:
            return Speed(value=json.loads(f"{{{ros_data}"))

    (failure,) = floats(Parsing, 1).failures
    assert (failure.rule, f"{__file__}:{line_of(Parsing.from_dict, 'json.loads')}," in failure.reason) == (
        "adapter-rejected",
        True,
    )


def test_python_adapter_rejection_has_index_and_log_time_in_topic_and_nested_fields(
    define: Callable[..., Definition],
) -> None:
    class Failing(SpeedAdapter):
        @classmethod
        def from_dict(cls, ros_data: dict[str, Any], **_: Any) -> Speed:
            return Speed(value=ros_data["pose"]["height"])

    definition = define("geometry_msgs/msg/PoseArray")
    shape = ros_shape(definition)
    rows = pa.array([{"poses": []}], shape)
    envelope = Envelope("/t", definition.root, np.array([7_000]), indices=np.array([41]))
    (failure,) = PythonAdapterSpec(Failing).bind(definition, shape).adapt(rows, envelope).failures
    assert "message 41, log time 7000 ns" in failure.reason
    for name in ("header.stamp.sec", "header.frame_id", "poses[].position.x", "poses[].orientation.w"):
        assert name in failure.reason


@pytest.mark.promise("adapter-translate")
def test_python_adapter_overridden_translate_receives_envelope(floats: Callable[..., Adapted]) -> None:
    class Shifted(SpeedAdapter):
        @classmethod
        def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:
            message = super().translate(ros_msg, name=ros_msg.topic, **kwargs)
            return Message(timestamp_ns=ros_msg.bag_timestamp_ns + 100, data=message.data)

    adapted = floats(Shifted, 5, 6)
    assert adapted.rows.to_pylist() == [{"value": 5.0, "name": "/topic"}, {"value": 6.0, "name": "/topic"}]
    assert adapted.log_times is not None
    assert adapted.log_times.tolist() == [100, 101]


def test_python_adapter_wrong_class_rejects_row(floats: Callable[..., Adapted]) -> None:
    class Wrong(SpeedAdapter):
        @classmethod
        def from_dict(cls, ros_data: dict[str, Any], **_: Any) -> Any:
            return None if ros_data["data"] else Speed(value=0)

    adapted = floats(Wrong, 1, 0)
    assert adapted.index.tolist() == [1]
    line = line_of(Wrong.from_dict, "@classmethod")
    assert "returned NoneType, expected Speed" in adapted.failures[0].reason
    assert f"{__file__}:{line}, message 0, log time 0 ns; fields: data" in adapted.failures[0].reason


def test_python_adapter_with_from_batch_receives_columns(floats: Callable[..., Adapted]) -> None:
    class ByColumns(SpeedAdapter):
        calls = 0

        @classmethod
        def from_batch(cls, rows: pa.StructArray) -> pa.StructArray:
            cls.calls += 1
            values = rows.field("data")
            columns = [values, pa.nulls(len(rows), pa.string())]
            missing = pa.array(np.asarray(values) == 7)
            return pa.StructArray.from_arrays(
                columns, fields=list(Speed.ontology_type().struct), mask=missing
            )

    adapted = floats(ByColumns, 1, 7, 3)
    assert ByColumns.calls == 1
    assert adapted.index.tolist() == [0, 2]
    assert adapted.rows.field("value").to_pylist() == [1, 3]
    line = line_of(ByColumns.from_batch, "@classmethod")
    (failure,) = adapted.failures
    assert (failure.row, failure.rule) == (1, "adapter-rejected")
    assert failure.reason == (
        f"ByColumns: from_batch returned null ({__file__}:{line}, message 1, log time 1 ns; fields: data)"
    )


def test_from_batch_exception_rejects_only_bad_rows(floats: Callable[..., Adapted]) -> None:
    class Picky(SpeedAdapter):
        @classmethod
        def from_batch(cls, rows: pa.StructArray) -> pa.StructArray:
            values = rows.field("data").to_pylist()
            if 13 in values:
                raise ValueError("thirteen")
            return pa.array([{"value": value} for value in values], Speed.ontology_type().struct)

    adapted = floats(Picky, *range(20))
    location = f"{__file__}:{line_of(Picky.from_batch, 'raise')}"
    assert adapted.index.tolist() == [*range(13), *range(14, 20)]
    assert [(failure.row, failure.reason) for failure in adapted.failures] == [
        (13, f"Picky: ValueError: thirteen ({location}, message 13, log time 13 ns; fields: data)")
    ]


def test_from_batch_wrong_column_type_raises(floats: Callable[..., Adapted]) -> None:
    class Broken(SpeedAdapter):
        @classmethod
        def from_batch(cls, rows: pa.StructArray) -> pa.Array:
            return rows.field("data")

    with pytest.raises(
        AdapterError, match=r"Broken.from_batch returned 1 rows of double, expected 1 rows of Speed"
    ):
        floats(Broken, 1)


def test_topic_metadata_reads_first_message(define: Callable[..., Definition]) -> None:
    class Telling(SpeedAdapter):
        @classmethod
        def schema_metadata(cls, ros_data: dict[str, Any], **_: Any) -> dict[str, Any] | None:
            return {"first": ros_data["data"]}

    definition = define("std_msgs/msg/Float64")
    rows = pa.array([{"data": 2.0}])
    bound = PythonAdapterSpec(Telling).bind(definition, rows.type)
    assert bound.topic_metadata(rows[0]) == {"first": 2.0}
    assert bound.topic_metadata(None) == {}
    assert PythonAdapterSpec(SpeedAdapter).bind(definition, rows.type).topic_metadata(rows[0]) == {}


def test_topic_metadata_accepts_any_parameter_name() -> None:
    class Renaming(SpeedAdapter):
        @classmethod
        def schema_metadata(cls, message: dict[str, Any], **_: Any) -> dict[str, Any] | None:  # type: ignore[override] - as users write it
            return {"first": message["data"]}

    row = pa.array([{"data": 2.0}])[0]
    assert PythonAdapter(Renaming, Speed.ontology_type()).topic_metadata(row) == {"first": 2.0}


def test_topic_metadata_exception_raises_adapter_error() -> None:
    class Failing(SpeedAdapter):
        @classmethod
        def schema_metadata(cls, ros_data: dict[str, Any], **_: Any) -> dict[str, Any] | None:
            return {"first": ros_data["missing"]}

    rows = pa.array([{"data": 2.0}])
    with pytest.raises(AdapterError, match=r"Failing.schema_metadata: KeyError: 'missing'"):
        PythonAdapter(Failing, Speed.ontology_type()).topic_metadata(rows[0])


def test_register_default_adapter_sets_default_of_its_types() -> None:
    assert register_default_adapter(SpeedAdapter) is SpeedAdapter
    assert registered_adapters()["std_msgs/msg/Float64"] is SpeedAdapter
    register_default_adapter(SpeedAdapter)

    class Other(SpeedAdapter): ...

    with pytest.raises(
        AdapterError, match=r"Other and .*SpeedAdapter both register as the default for std_msgs/msg/Float64"
    ):
        register_default_adapter(Other)


def test_adapter_class_without_member_raises_with_its_name(define: Callable[..., Definition]) -> None:
    class NoType(ROSAdapterBase[Speed]): ...

    class NoOntology(ROSAdapterBase[Speed]):
        ros_msgtype = ("std_msgs/msg/Float64",)

    with pytest.raises(AdapterError, match="NoType has no ros_msgtype"):
        _ = PythonAdapterSpec(NoType).ros_types
    with pytest.raises(AdapterError, match="NoOntology has no __mosaico_ontology_type__"):
        PythonAdapterSpec(NoOntology).bind(define("std_msgs/msg/Float64"), pa.struct([]))
    with pytest.raises(AdapterError, match="int is no ontology class"):
        ontology_of(int)


_FILE = """
from mosaico_ingest.adapters import ROSAdapterBase
from mosaico_ingest.ontology import Serializable
from beside import FACTOR

class {name}Row(Serializable):
    value: float

class {name}(ROSAdapterBase[{name}Row]):
    ros_msgtype = "std_msgs/msg/Float64"
    __mosaico_ontology_type__ = {name}Row

    @classmethod
    def from_dict(cls, ros_data):
        return {name}Row(value=FACTOR * ros_data["data"])
"""


def test_file_reference_loads_and_pickles(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text("FACTOR = 2\n")
    (tmp_path / "mine.py").write_text(_FILE.format(name="Doubling"))
    spec = load_adapter_reference("mine.py:Doubling", tmp_path)
    assert (spec.name, spec.ros_types, spec.default) == ("Doubling", ("std_msgs/msg/Float64",), True)
    again = pickle.loads(pickle.dumps(spec))  # noqa: S301 - pickled in this line
    assert again == spec


def test_module_reference_finds_module_next_to_manifest(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text("FACTOR = 2\n")
    (tmp_path / "adapters_of_mine.py").write_text(_FILE.format(name="Tripling"))
    assert load_adapter_reference("adapters_of_mine:Tripling", tmp_path).name == "Tripling"


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ("import os\nraise RuntimeError('no\\nlicence')\n", "broken.py:2", "RuntimeError: no licence"),
        ("def f(:\n    pass\n", "broken.py:1", "SyntaxError"),
        ("import nothing_like_it\n", "broken.py:1", "No module named 'nothing_like_it'"),
    ],
)
def test_module_reference_import_error_names_file_and_line(
    tmp_path: Path, text: str, place: str, reason: str
) -> None:
    (tmp_path / "broken.py").write_text(text)
    with pytest.raises(AdapterError) as caught:
        load_adapter_reference("broken.py:Adapter", tmp_path)
    assert str(caught.value).count("\n") == 0
    assert place in str(caught.value)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("ref", "reason"),
    [
        ("IMUAdaptor", "did you mean IMUAdapter?"),
        ("nowhere.py:Adapter", "there is no file"),
        ("no_such_module_here:Adapter", "there is no module no_such_module_here"),
        ("mine.py:Doublin", "did you mean Doubling?"),
    ],
)
def test_reference_to_missing_adapter_suggests_names(tmp_path: Path, ref: str, reason: str) -> None:
    (tmp_path / "beside.py").write_text("FACTOR = 2\n")
    (tmp_path / "mine.py").write_text(_FILE.format(name="Doubling"))
    with pytest.raises(AdapterError, match=reason.replace("?", r"\?")):
        load_adapter_reference(ref, tmp_path)


def test_adapter_spec_of_other_object_raises() -> None:
    with pytest.raises(AdapterError, match="int 3 "):
        adapter_spec(3, Path())
    with pytest.raises(AdapterError, match="Speed "):
        adapter_spec(Speed, Path())
