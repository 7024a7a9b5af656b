"""The tree of frames, also of transforms that form no tree."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.view.tracks import FrameEdge, FrameNode, frame_trees, read_edges


def edge(parent: str, child: str) -> FrameEdge:
    return FrameEdge(parent, child, "/tf", 1, None)


def names(nodes: tuple[FrameNode, ...] | list[FrameNode]) -> dict[str, object]:
    return {node.name: names(node.children) for node in nodes}


def count(nodes: tuple[FrameNode, ...] | list[FrameNode]) -> int:
    return sum(1 + count(node.children) for node in nodes)


def test_trees_nest_frames_below_their_parents() -> None:
    edges = [edge("odom", "base"), edge("map", "odom"), edge("base", "imu"), edge("base", "camera")]
    assert names(frame_trees(edges)) == {"map": {"odom": {"base": {"camera": {}, "imu": {}}}}}


def test_trees_of_a_cycle_contain_every_frame() -> None:
    assert count(frame_trees([edge("a", "b"), edge("b", "a"), edge("x", "y")])) == 4


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=30))
def test_trees_of_any_edges_contain_every_frame_once(pairs: list[tuple[int, int]]) -> None:
    edges = [edge(str(parent), str(child)) for parent, child in dict.fromkeys(pairs)]
    trees = frame_trees(edges)
    frames = {name for one in edges for name in (one.parent, one.child)}

    def walk(nodes: tuple[FrameNode, ...] | list[FrameNode]) -> list[str]:
        return [name for node in nodes for name in (node.name, *walk(node.children))]

    assert sorted(walk(trees)) == sorted(frames)


def test_trees_of_a_long_chain_need_no_recursion() -> None:
    assert len(frame_trees([edge(str(at), str(at + 1)) for at in range(1900)])) == 1


def test_edges_of_quickstart_count_transforms(quickstart: Store) -> None:
    (actual,) = read_edges(quickstart.sequence("quickstart_drive").topics)
    assert (actual.parent, actual.child, actual.rows) == ("odom", "base_link", 200)
    assert actual.translation is not None
    assert round(actual.translation[0], 3) == 5
