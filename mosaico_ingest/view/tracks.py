"""Positions of bodies and coordinate frames: GPS tracks, trajectories and trees of transforms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.view.columns import Column, is_number, topic_columns
from mosaico_ingest.view.rows import column_schema

_EARTH_M = 6_371_008.8
"""Mean radius of the Earth in m."""
_NO_FIX = -1
_BODIES = (
    "pose.pose.position.",
    "pose.position.",
    "position.",
    "translation.",
    "transform.translation.",
    "point.",
)
"""Prefixes of the coordinates of a body."""
MAX_FRAMES = 2_000
"""Maximum number of frames of a tree."""


class Track(Struct, frozen=True):
    """Positions of one topic in order of time, without rows that have no position."""

    topic: str
    is_gps: bool
    times_ns: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float64]
    """Of shape (n, 3): x, y, z in m; of a GPS track latitude and longitude in degrees and altitude in m."""
    frame_id: str
    """The coordinate frame of the first position, or an empty text."""
    rows: int
    """Number of rows with a position, of which `positions` contains some."""


class _Source(Struct, frozen=True):
    axes: tuple[Column, ...]
    """Two or three coordinates."""
    status: Column | None
    frame: Column | None
    is_gps: bool


def has_track(topic: TopicInfo) -> bool:
    """Return whether the rows of a topic have positions."""
    return _source(topic) is not None


def read_track(topic: TopicInfo, *, max_points: int = 5_000) -> Track | None:
    """Return at most `max_points` positions at equal distances in the rows, or None if the topic has none.

    Only the columns of the positions are read.
    """
    source = _source(topic)
    if source is None:
        return None
    every = max(1, -(-topic.rows // max_points))
    times: list[npt.NDArray[np.int64]] = []
    positions: list[npt.NDArray[np.float64]] = []
    rows, frame_id = 0, ""
    for batch in _batches(topic, source):
        coordinates = _coordinates(batch, source)
        valid = np.isfinite(coordinates[:, :2]).all(axis=1) & _has_fix(batch, source)
        selected = np.flatnonzero(valid)
        if len(selected) and not rows and source.frame is not None:
            frame_id = str(source.frame.values(batch)[int(selected[0])].as_py() or "")
        rows_of_track = selected[(-rows) % every :: every]
        rows += len(selected)
        times.append(batch.column(0).to_numpy()[rows_of_track])
        positions.append(coordinates[rows_of_track])
    empty_times, empty_positions = np.empty(0, np.int64), np.empty((0, 3))
    return Track(
        topic.name,
        source.is_gps,
        np.concatenate([empty_times, *times]),
        np.concatenate([empty_positions, *positions]),
        frame_id,
        rows,
    )


def local_meters(track: Track) -> npt.NDArray[np.float64]:
    """Return the positions as east and north in m, of shape (n, 2), relative to the first one of a GPS track."""
    if not track.is_gps or not len(track.positions):
        return track.positions[:, :2]
    latitude, longitude = np.radians(track.positions[:, 0]), np.radians(track.positions[:, 1])
    turn = (longitude - longitude[0] + math.pi) % (2 * math.pi) - math.pi
    east = turn * math.cos(float(latitude[0])) * _EARTH_M
    return np.stack([east, (latitude - latitude[0]) * _EARTH_M], axis=1)


def _source(topic: TopicInfo) -> _Source | None:
    columns = {column.path: column for column in topic_columns(topic.schema) if "[]" not in column.path}
    frame = columns.get("header.frame_id")
    if topic.ontology.tag == "GPS":
        names = ("position.x", "position.y", "position.z")
        return _Source(
            tuple(columns[name] for name in names), columns.get("status.status"), frame, is_gps=True
        )
    for names in (("latitude", "longitude", "altitude"), ("lat", "lon", "alt")):
        if all(name in columns and is_number(columns[name].type) for name in names[:2]):
            axes = tuple(columns[name] for name in names if name in columns)
            return _Source(axes, columns.get("status.status"), frame, is_gps=True)
    prefixes = (
        (*_BODIES, "") if {"theta", "yaw"} & set(columns) or topic.ontology.tag == "Point3d" else _BODIES
    )
    for prefix in prefixes:
        axes = tuple(columns[f"{prefix}{axis}"] for axis in "xyz" if f"{prefix}{axis}" in columns)
        if len(axes) >= 2 and all(is_number(axis.type) for axis in axes):  # noqa: PLR2004 - x and y
            return _Source(axes, None, frame, is_gps=False)
    return None


def _batches(topic: TopicInfo, source: _Source) -> Iterator[pa.RecordBatch]:
    columns = [
        *source.axes,
        *([source.status] if source.status else []),
        *([source.frame] if source.frame else []),
    ]
    return scan(topic.segments, column_schema(topic, (column.name for column in columns)), Window())


def _coordinates(batch: pa.RecordBatch, source: _Source) -> npt.NDArray[np.float64]:
    coordinates = np.zeros((batch.num_rows, 3))
    for at, column in enumerate(source.axes):
        values = column.values(batch).cast(pa.float64(), safe=False)
        coordinates[:, at] = values.to_numpy(zero_copy_only=False)
    return coordinates


def _has_fix(batch: pa.RecordBatch, source: _Source) -> npt.NDArray[np.bool_]:
    if source.status is None or not is_number(source.status.type):
        return np.ones(batch.num_rows, bool)
    status = source.status.values(batch).cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return ~(status <= _NO_FIX)


class FrameEdge(Struct, frozen=True):
    """A frame and its parent."""

    parent: str
    child: str
    topic: str
    rows: int
    """Number of transforms."""
    translation: tuple[float, float, float] | None
    """The first translation in m."""


class FrameNode(Struct, frozen=True):
    """A frame with the frames below it."""

    name: str
    edge: FrameEdge | None
    """The transform from the frame to its parent; None for a root."""
    children: tuple[FrameNode, ...]


def has_transforms(topic: TopicInfo) -> bool:
    """Return whether the rows of a topic are transforms between frames."""
    names = set(topic.schema.names)
    is_tree = topic.ontology.tag == "FrameTransform" and "transforms" in names
    return is_tree or (topic.ontology.tag == "Transform" and {"header", "target_frame_id"} <= names)


def read_edges(topics: Iterable[TopicInfo]) -> list[FrameEdge]:
    """Return the edges of all transform topics, in the order of their first row."""
    counts: dict[tuple[str, str], tuple[str, int, Any]] = {}
    for topic in topics:
        if not has_transforms(topic):
            continue
        nested = topic.ontology.tag == "FrameTransform"
        names = ["transforms"] if nested else ["header", "target_frame_id", "translation"]
        schema = column_schema(topic, names)
        for batch in scan(topic.segments, schema, Window()):
            for parent, child, rows, translation in _batch_edges(batch, nested=nested):
                edge = counts.get((parent, child))
                if edge is not None:
                    counts[parent, child] = (edge[0], edge[1] + rows, edge[2])
                elif len(counts) < MAX_FRAMES:
                    counts[parent, child] = (topic.name, rows, translation)
    return [
        FrameEdge(parent, child, topic, rows, _vector(translation))
        for (parent, child), (topic, rows, translation) in counts.items()
    ]


def frame_trees(edges: Iterable[FrameEdge]) -> list[FrameNode]:
    """Return the trees of frames. A frame below itself, or below several parents, appears once in each branch."""
    children: dict[str, list[FrameEdge]] = {}
    for edge in edges:
        children.setdefault(edge.parent, []).append(edge)
    below = {edge.child for members in children.values() for edge in members}
    roots = [name for name in children if name not in below] or list(children)[:1]
    reached: set[str] = set()
    trees = [_grow(root, None, children, reached) for root in roots]
    cycles = [name for name in children if name not in reached]
    while cycles:
        trees.append(_grow(cycles[0], None, children, reached))
        cycles = [name for name in cycles if name not in reached]
    return trees


def _grow(
    name: str, edge: FrameEdge | None, children: dict[str, list[FrameEdge]], reached: set[str]
) -> FrameNode:
    """Return a frame with the frames below it that are not part of the tree yet, without recursion."""
    order: list[tuple[str, FrameEdge | None, int]] = [(name, edge, -1)]
    reached.add(name)
    for at, (parent, _, _) in enumerate(order):  # grows while it is iterated
        for each in children.get(parent, ()):
            if each.child not in reached:
                reached.add(each.child)
                order.append((each.child, each, at))
    members: list[list[FrameNode]] = [[] for _ in order]
    node = FrameNode(name, edge, ())
    for at in range(len(order) - 1, -1, -1):
        frame, above, parent_at = order[at]
        node = FrameNode(frame, above, tuple(sorted(members[at], key=lambda each: each.name)))
        if parent_at >= 0:
            members[parent_at].append(node)
    return node


def _batch_edges(batch: pa.RecordBatch, *, nested: bool) -> Iterable[tuple[str, str, int, Any]]:
    """Yield parent, child, number of transforms and the first translation of each edge in a batch."""
    rows: Any = batch.column(1) if nested else batch
    structs: Any = (
        rows.flatten()
        if nested
        else pa.StructArray.from_arrays(batch.columns[1:], names=batch.schema.names[1:])
    )
    table = pa.table(
        {
            "parent": structs.field("header").field("frame_id"),
            "child": structs.field("target_frame_id"),
            "at": pa.array(range(len(structs)), pa.int64()),
        }
    )
    groups = table.group_by(["parent", "child"], use_threads=False).aggregate(
        [("at", "min"), ("at", "count")]
    )
    for group in sorted(groups.to_pylist(), key=lambda each: each["at_min"]):
        translation = structs[group["at_min"]].as_py()["translation"]
        yield group["parent"] or "", group["child"] or "", group["at_count"], translation


def _vector(translation: Any) -> tuple[float, float, float] | None:  # noqa: ANN401 - a struct as Python values
    if not isinstance(translation, dict) or any(translation.get(axis) is None for axis in "xyz"):
        return None
    return (float(translation["x"]), float(translation["y"]), float(translation["z"]))
