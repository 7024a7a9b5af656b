"""The contract of every adapter of the catalog, for every type that it accepts."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest import adapters
from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.builtin import (
    BUILTIN,
    BY_NAME,
    BY_TYPE,
    CATALOG,
    Builtin,
    find_builtin,
)
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.adapters.python import ROSAdapterBase
from mosaico_ingest.adapters.standalone import run_tests
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.ontology.registry import ontology_type
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

EVERY = pytest.mark.parametrize("builtin", BUILTIN, ids=lambda builtin: builtin.name)
PAIRS = pytest.mark.parametrize(
    ("builtin", "msgtype"),
    [
        pytest.param(builtin, name, id=f"{builtin.name}-{name}")
        for builtin in BUILTIN
        for name in builtin.ros_types
        if "/" in name  # tests/adapters/test_foxglove.py has the types in other encodings
    ],
)
FINGERPRINTS = json.loads((Path(__file__).parents[1] / "ontology" / "fingerprints.json").read_text())
ROWS = 40

Define = Callable[..., Definition]
Fuzzed = Callable[[Definition, int], list[dict[str, Any]]]
Adapt = Callable[..., Adapted]


def test_catalog_lists_every_file_once() -> None:
    assert sorted(builtin.path for builtin in BUILTIN) == sorted(CATALOG.glob("*.yaml"))
    assert len(BY_NAME) == len(BUILTIN)


def test_catalog_types_have_one_default_adapter() -> None:
    defaults = [name for builtin in BUILTIN if builtin.default for name in builtin.ros_types]
    assert len(defaults) == len(set(defaults)) == len(BY_TYPE)


@EVERY
def test_catalog_entry_matches_its_file(builtin: Builtin) -> None:
    mapping = builtin.mapping
    attributes = (mapping.name, mapping.ontology.tag, mapping.ros_types, mapping.default)
    assert attributes == (builtin.name, builtin.tag, builtin.ros_types, builtin.default)
    assert mapping.model.description
    assert not mapping.model.description.endswith(".")


@EVERY
def test_catalog_json_entry_matches_its_file(builtin: Builtin) -> None:
    known, read = builtin.mapping, load_adapter(builtin.path, adapters=find_builtin)
    assert repr(known.model) == repr(read.model)  # not a number is not even equal to itself
    assert known.source == read.source
    assert known.ontology == read.ontology


@EVERY
def test_catalog_adapter_passes_its_tests(builtin: Builtin) -> None:
    outcomes = run_tests(builtin.mapping, TypeResolver(Stores.LATEST))
    assert outcomes
    assert [f"{builtin.stem}.yaml:{o.line}: {o.name}: {o.problems}" for o in outcomes if not o.passed] == []


@EVERY
def test_catalog_adapter_pickles(builtin: Builtin) -> None:
    assert pickle.loads(pickle.dumps(builtin)) == builtin  # noqa: S301 - pickled in this line


def _definitions(define: Define, msgtype: str) -> list[Definition]:
    """Return the definitions of the type in ROS 1 and ROS 2, as far as they exist."""
    actual: list[Definition] = []
    for distro in (Stores.LATEST, Stores.ROS2_FOXY, Stores.ROS1_NOETIC):
        with suppress(BagError):
            actual.append(define(msgtype, distro))
    assert actual
    return actual


@PAIRS
def test_catalog_adapter_rows_have_ontology_type(builtin: Builtin, msgtype: str, define: Define) -> None:
    for definition in _definitions(define, msgtype):
        bound = builtin.bind(definition, ros_shape(definition))
        assert bound.ontology == ontology_type(builtin.tag)
        assert bound.ontology.fingerprint == FINGERPRINTS[builtin.tag][0]


@PAIRS
def test_catalog_adapter_empty_batch_returns_no_rows(
    builtin: Builtin, msgtype: str, define: Define, adapt: Adapt
) -> None:
    for definition in _definitions(define, msgtype):
        adapted = adapt(builtin, definition, [])
        assert adapted.rows.type == ontology_type(builtin.tag).struct
        assert (len(adapted.rows), len(adapted.index), adapted.failures) == (0, 0, ())


@PAIRS
def test_catalog_adapter_random_rows_are_adapted_or_rejected(
    builtin: Builtin, msgtype: str, define: Define, adapt: Adapt, fuzzed: Fuzzed
) -> None:
    for definition in _definitions(define, msgtype):
        adapted = adapt(builtin, definition, fuzzed(definition, ROWS))
        failed = [failure.row for failure in adapted.failures]
        assert adapted.rows.type == ontology_type(builtin.tag).struct
        assert len(adapted.rows) == len(adapted.index)
        assert sorted([*adapted.index.tolist(), *failed]) == list(range(ROWS))
        assert adapted.index.tolist() == sorted(adapted.index.tolist())
        assert failed == sorted(failed)
        adapted.rows.validate(full=True)
        _assert_required(adapted.rows, builtin.tag)


@PAIRS
def test_catalog_adapter_batch_equals_single_rows(
    builtin: Builtin, msgtype: str, define: Define, adapt: Adapt, fuzzed: Fuzzed
) -> None:
    definition = _definitions(define, msgtype)[0]
    messages = fuzzed(definition, ROWS // 4)
    together = adapt(builtin, definition, messages)
    alone = [adapt(builtin, definition, [message]) for message in messages]
    assert [bool(one.failures) for one in alone] == [
        row not in together.index for row in range(len(messages))
    ]
    reasons = [failure.reason for one in alone for failure in one.failures]
    assert [failure.reason for failure in together.failures] == reasons
    # text compares NaN as equal
    assert str(together.rows.to_pylist()) == str([row for one in alone for row in one.rows.to_pylist()])


@PAIRS
def test_catalog_adapter_slice_equals_batch(
    builtin: Builtin, msgtype: str, define: Define, fuzzed: Fuzzed
) -> None:
    definition = _definitions(define, msgtype)[0]
    shape = ros_shape(definition)
    messages = fuzzed(definition, 8)
    bound = builtin.bind(definition, shape)
    whole, own = pa.array(messages, shape), pa.array(messages[3:6], shape)
    sliced, copied = (bound.adapt(rows, _envelope(definition, 3)) for rows in (whole.slice(3, 3), own))
    assert str(sliced.rows.to_pylist()) == str(copied.rows.to_pylist())
    assert sliced.failures == copied.failures


def _envelope(definition: Definition, count: int) -> Envelope:
    return Envelope("/topic", definition.root, np.zeros(count, np.int64))


def _assert_required(rows: Any, where: str) -> None:
    """Fail if a non-nullable field is null in a struct that is not null."""
    if not pa.types.is_struct(rows.type):
        if pa.types.is_list(rows.type) or pa.types.is_fixed_size_list(rows.type):
            _assert_required(rows.flatten(), f"{where}[]")
        return
    present = rows.filter(rows.is_valid())
    for field, column in zip(rows.type, present.flatten(), strict=True):
        assert field.nullable or column.null_count == 0, f"{where}.{field.name} is null"
        _assert_required(column, f"{where}.{field.name}")


def test_catalog_adapter_is_importable_class() -> None:
    for builtin in BUILTIN:
        adapter = getattr(adapters, builtin.name)
        assert issubclass(adapter, ROSAdapterBase)
        assert adapter.__name__ == builtin.name
        assert adapter.ros_msgtype == builtin.ros_types
        assert adapter.__mosaico_ontology_type__.ontology_tag() == builtin.tag
        assert pickle.loads(pickle.dumps(adapter)) is adapter  # noqa: S301 - pickled in this line
    assert set(BY_NAME) <= set(dir(adapters))
    with pytest.raises(AttributeError, match="NoSuchAdapter"):
        _ = adapters.NoSuchAdapter


def test_catalog_class_translates_single_message() -> None:
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"}
    pose = {
        "position": {"x": 1.0, "y": 2.0, "z": 3.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    assert adapters.PoseAdapter.from_dict(pose).position.y == 2.0
    message = ROSMessage(7, "/pose", "geometry_msgs/PoseStamped", {"header": header, "pose": pose})
    translated = adapters.PoseAdapter.translate(message)
    assert translated.timestamp_ns == 7
    assert translated.ontology_tag() == "Pose"
    assert translated.data.header.frame_id == "map"
    assert adapters.PoseAdapter.schema_metadata(pose) is None
    image = {"header": header, "format": "rgb8; jpeg compressed bgr8", "data": b"\xff\xd8"}
    assert adapters.CompressedImageAdapter.schema_metadata(image) == {
        "ros_format": "rgb8; jpeg compressed bgr8"
    }


def test_catalog_class_from_dict_accepts_ros1_fields() -> None:
    header = {"seq": 9, "stamp": {"sec": 0, "nanosec": 0}, "frame_id": "imu"}
    vector = {"x": 1.0, "y": 2.0, "z": 3.0}
    translated = adapters.Vector3Adapter.from_dict({"header": header, "vector": vector})
    assert translated.header.sample_counter == 9
    sentence = {"header": header, "sentence": "$GP"}
    assert adapters.NMEASentenceAdapter.from_dict(sentence).sentence == "$GP"
    tree = {"transforms": []}
    assert (
        adapters.FrameTransformAdapter.translate(ROSMessage(0, "/tf", "tf/tfMessage", tree)).data.transforms
        == []
    )


def test_catalog_class_from_dict_invalid_raises() -> None:
    with pytest.raises(AdapterError, match=r"Vector3Adapter: .* has no field xx"):
        adapters.Vector3Adapter.from_dict({"xx": 1.0})
    with pytest.raises(AdapterError, match="StringStdAdapter: data"):
        adapters.StringStdAdapter.from_dict({})


def test_catalog_class_can_be_subclassed() -> None:
    class Louder(adapters.StringStdAdapter):
        @classmethod
        def from_dict(cls, ros_data: dict[str, Any]) -> Any:
            return super().from_dict({"data": ros_data["data"].upper()})

    assert Louder.translate(ROSMessage(1, "/s", "std_msgs/msg/String", {"data": "hi"})).data.data == "HI"


def test_catalog_import_reads_no_adapter_file() -> None:
    script = (
        "import sys, mosaico_ingest.adapters.builtin as b\n"
        "opened = []\n"
        "sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == 'open' else None)\n"
        "assert b.BY_TYPE['sensor_msgs/msg/Imu'].tag == 'IMU'\n"
        "assert not opened\n"
        "b.BY_TYPE['sensor_msgs/msg/Imu'].mapping\n"
        "print([name for name in opened if name.endswith('.yaml')])\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)  # noqa: S603 - our own script
    assert result.stdout.strip() == "[]"
