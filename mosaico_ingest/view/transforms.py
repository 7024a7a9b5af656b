"""The tree of coordinate frames that the transform topics of a sequence describe."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan

MAX_FRAMES = 2_000
"""Maximum number of frames of a tree."""


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
        schema = pa.schema([topic.schema.field(name) for name in (topic.schema.names[0], *names)])
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
