"""Comparison of our adapters with those of the official SDK on the same messages; each difference is listed with its reason."""

from __future__ import annotations

import fnmatch
import io
import math
import runpy
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.adapters.adapter import Adapted, AdapterSpec, EncodedImageSpec, Envelope
from mosaico_ingest.adapters.builtin import (
    BUILTIN,
    BY_NAME,
    BY_TYPE,
    Builtin,
)
from mosaico_ingest.adapters.python import ontology_of
from mosaico_ingest.errors import BagError
from mosaico_ingest.job.fields import ImageSettings
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

pytestmark = pytest.mark.interop
sdk = pytest.importorskip("mosaicolabs.bridges.ros", reason="the official SDK is not installed")
from mosaicolabs.bridges.ros.adapters import override_msgs  # noqa: E402 - only once it is known to be there
from mosaicolabs.models.core.serializable import _SCHEMA_REGISTRY as SDK_MODELS  # noqa: E402 - the same
from PIL import Image  # noqa: E402 - comes with it

ROWS = 200
IMAGE = "sensor_msgs/msg/Image"
NOT_IN_THE_DISTROS = {
    name: text.replace(b.ros_types[0].split("/")[0], name.split("/")[0])
    for b in BUILTIN
    if (text := b.mapping.model.definition)
    for name in b.ros_types
    if "/" in name  # the SDK's ROS bridge knows no types of protobuf and JSON
}


@dataclass(frozen=True)
class Mended:
    """A difference that is meant: for which type, in which columns or with which error (globs), and why."""

    msgtype: str
    where: str
    why: str


DIFFERENT = (
    Mended("sensor_msgs/msg/Imu", "acceleration.[xyz]", "a covariance of -1 says not measured: NaN"),
    Mended("sensor_msgs/msg/Imu", "angular_velocity.[xyz]", "a covariance of -1 says not measured: NaN"),
    Mended("sensor_msgs/msg/CameraInfo", "binning*", "binning on one axis is kept; 0 means 1"),
    Mended("sensor_msgs/msg/CompressedImage", "format", "the codec is found wherever the text names it"),
)
"""Both take the message, and store other values."""

ONLY_OURS = (
    Mended(
        "sensor_msgs/msg/CameraInfo",
        "*distortion_parameters*",
        "a camera without distortion has no parameters",
    ),
    Mended(
        "sensor_msgs/msg/CompressedImage",
        "*format*",
        "a format text of any shape is no reason to lose the picture",
    ),
)
"""The SDK rejects the message, with words like these; we store it."""


def _default_adapters() -> dict[str, Any]:
    return dict(sdk.ROSBridge.get_default_adapters())


@pytest.fixture(scope="module")
def fuzz() -> Any:
    return runpy.run_path(str(Path(__file__).parents[1] / "adapters" / "fuzz.py"))["message"]


def _definitions(msgtype: str) -> Iterator[Definition]:
    for distro, version in ((Stores.LATEST, 2), (Stores.ROS1_NOETIC, 1)):
        with suppress(BagError):
            yield TypeResolver(distro, types=NOT_IN_THE_DISTROS).resolve(msgtype, None, ros_version=version)


def test_type_adapted_by_the_sdk_has_the_same_ontology_type() -> None:
    theirs = {
        name: ontology_of(adapter.__mosaico_ontology_type__) for name, adapter in _default_adapters().items()
    }
    assert len(theirs) == 63
    ours = {name: BY_TYPE[name].mapping.ontology for name in theirs}
    assert ours == theirs


@pytest.mark.parametrize("msgtype", sorted({*_default_adapters()} - {IMAGE}))
def test_adapted_rows_equal_those_of_the_sdk(msgtype: str, fuzz: Any) -> None:
    adapter = _default_adapters()[msgtype]
    for definition in _definitions(msgtype):
        random = Random(msgtype)  # noqa: S311 - messages, not secrets
        _compare(adapter, BY_TYPE[msgtype], definition, [fuzz(definition, random) for _ in range(ROWS)])


@pytest.mark.parametrize("builtin", BUILTIN, ids=lambda builtin: builtin.name)
def test_sdk_reads_every_row_as_its_own_type(builtin: Builtin, fuzz: Any) -> None:
    model = SDK_MODELS[builtin.tag]
    for msgtype in builtin.ros_types:
        for definition in _definitions(msgtype):
            random = Random(msgtype)  # noqa: S311 - messages, not secrets
            adapted = _ours(builtin, definition, [fuzz(definition, random) for _ in range(ROWS // 4)])
            for row in adapted.rows.to_pylist():
                model.model_validate(row)


def test_stored_images_equal_those_of_the_sdk() -> None:
    (definition, *_) = _definitions(IMAGE)
    random = Random(IMAGE)  # noqa: S311 - messages, not secrets
    adapter = _default_adapters()[IMAGE]
    for _ in range(ROWS):
        height, step = random.randrange(4), random.randrange(7)
        message = {
            "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "camera"},
            "height": height, "width": step // 3, "step": step, "encoding": "rgb8",
            "is_bigendian": random.choice((0, 1)), "data": random.randbytes(height * step + random.choice((0, 0, 1))),
        }  # fmt: skip
        theirs, _ = _theirs(adapter, message, BY_NAME["ImageAdapter"].mapping.ontology.struct)
        (ours,) = _ours(
            EncodedImageSpec(BY_NAME["ImageAdapter"], ImageSettings(format="buffer_png")),
            definition,
            [message],
        ).rows.to_pylist()
        assert _with_pixels(ours) == _with_pixels(theirs)


def _with_pixels(row: dict[str, Any]) -> dict[str, Any]:
    if row["format"] == "png":
        picture = Image.open(io.BytesIO(row["data"]))
        return {**row, "data": (picture.mode, picture.size, picture.tobytes())}
    return row


OPT_IN = {
    name: getattr(override_msgs, name)
    for name in (
        "LidarAdapter",
        "RadarAdapter",
        "RGBDCameraAdapter",
        "ToFCameraAdapter",
        "StereoCameraAdapter",
    )
}


@pytest.mark.parametrize("name", OPT_IN)
def test_unpacked_point_clouds_equal_those_of_the_sdk(name: str) -> None:
    (definition, *_) = _definitions("sensor_msgs/msg/PointCloud2")
    random = Random(name)  # noqa: S311 - messages, not secrets
    clouds = [_cloud(random, name) for _ in range(60)]
    _compare(OPT_IN[name], BY_NAME[name], definition, clouds)


def _cloud(random: Random, name: str) -> dict[str, Any]:
    """Return a cloud of named fields in any order and place, whose values every column can hold."""
    wanted = [field.name for field in BY_NAME[name].mapping.ontology.struct][4:]
    names = ["x", "y", "z", *random.sample(wanted, random.randint(0, len(wanted))), "unknown"]
    random.shuffle(names)
    integers = {"reflectivity", "beam_id", "confidence", "return_type", "luma", "cost"}
    kinds = {n: random.choice((2, 4) if n in integers else (7,)) for n in names}
    fields, offset = [], random.choice((0, 3))
    for field in names:
        fields.append({"name": field, "offset": offset, "datatype": kinds[field], "count": 1})
        offset += {2: 1, 4: 2, 7: 4}[kinds[field]] + random.choice((0, 1))
    height, width, big = random.choice((1, 2)), random.choice((0, 1, 7)), random.random() < 0.5
    points = height * width
    step = offset + random.choice((0, 5))
    data = np.zeros((points, step), np.uint8)
    for field in fields:
        dtype = np.dtype({2: "u1", 4: "u2", 7: "f4"}[field["datatype"]]).newbyteorder(">" if big else "<")
        values = np.array([random.randrange(200) for _ in range(points)]).astype(dtype)
        data[:, field["offset"] : field["offset"] + dtype.itemsize] = values.view(np.uint8).reshape(
            points, dtype.itemsize
        )
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "lidar"}
    return {
        "header": header, "height": height, "width": width, "fields": fields, "is_bigendian": big,
        "point_step": step, "row_step": step * width, "data": data.tobytes(), "is_dense": True,
    }  # fmt: skip


def _compare(adapter: Any, builtin: Builtin, definition: Definition, messages: list[dict[str, Any]]) -> None:
    adapted = _ours(builtin, definition, messages)
    ours = dict(zip(adapted.index.tolist(), adapted.rows.to_pylist(), strict=True))
    problems: list[str] = []
    both = 0
    for row, message in enumerate(messages):
        theirs, error = _theirs(adapter, message, adapted.rows.type)
        both += row in ours and theirs is not None
        refusal = next((failure.reason for failure in adapted.failures if failure.row == row), error)
        explanation = _explained(definition.root, ours.get(row), theirs, refusal)
        problems += [f"row {row}: {problem}\n  in {message}" for problem in explanation]
    assert problems[:3] == []
    assert both > len(messages) / 4, "too few messages that both take"


def _ours(builtin: AdapterSpec, definition: Definition, messages: list[dict[str, Any]]) -> Adapted:
    shape = ros_shape(definition)
    envelope = Envelope("/topic", definition.root, np.zeros(len(messages), np.int64))
    return builtin.bind(definition, shape).adapt(pa.array(messages, shape), envelope)


def _theirs(adapter: Any, message: dict[str, Any], struct: pa.StructType) -> tuple[Any, str | None]:
    """Return the row the SDK stores, through the same columns, or why it stores none."""
    try:
        value = adapter.from_dict(_lists(message))
        return pa.array([value.model_dump()], struct).to_pylist()[0], None
    except Exception as error:  # noqa: BLE001 - whatever it raises is how it rejects a message
        return None, " ".join(str(error).split())[:200]


def _lists(value: Any) -> Any:
    """Return a message as the SDK's loader makes it: bytes are lists of numbers."""
    if isinstance(value, dict):
        return {name: _lists(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_lists(item) for item in value]
    return list(value) if isinstance(value, bytes) else value


def _explained(msgtype: str, ours: Any, theirs: Any, error: str | None) -> Iterator[str]:
    if ours is None and theirs is None:
        return
    if ours is None:
        yield f"only the SDK takes it: {error}"
        return
    if theirs is None:
        if not _listed(ONLY_OURS, msgtype, error or ""):
            yield f"only we take it: {error}"
        return
    for column, one, other in _differences(ours, theirs, ""):
        if not _listed(DIFFERENT, msgtype, column):
            yield f"{column}: ours {one!r}, the SDK's {other!r}"


def _listed(table: tuple[Mended, ...], msgtype: str, where: str) -> bool:
    return any(m.msgtype == msgtype and fnmatch.fnmatchcase(where, m.where) for m in table)


def _differences(one: Any, other: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(one, dict) and isinstance(other, dict):
        for name, value in one.items():
            yield from _differences(value, other[name], f"{path}.{name}".lstrip("."))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for i, (left, right) in enumerate(zip(one, other, strict=True)):
            yield from _differences(left, right, f"{path}[{i}]")
    elif not (one == other or (_is_nan(one) and _is_nan(other))):
        yield path, one, other


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def test_every_listed_difference_names_an_own_type() -> None:
    known = {name for builtin in BUILTIN for name in builtin.ros_types}
    assert {m.msgtype for m in (*DIFFERENT, *ONLY_OURS)} <= known
