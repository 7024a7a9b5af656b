"""The differences of two plans are complete and correct."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.pipeline.plan_document import differences

TOPIC: dict[str, Any] = {
    "topic": "/a",
    "target": "/a",
    "msgtype": "p/msg/A",
    "definitions": ["bag 00"],
    "adapter": {"name": "A", "digest": None},
    "why": "built-in",
    "ontology": {"tag": "O", "fingerprint": "f", "serialization_format": "default"},
    "count": 3,
    "every": 1,
    "on_error": "raise",
    "metadata": {},
}


def plan(*, name: str = "s", metadata: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    return {
        "sequence": {"name": name, "family": name, "metadata": metadata or {}, "if_exists": "fail"},
        "files": [{"path": "x.bag", "size_bytes": 1}],
        "container": "ros1",
        "start_ns": 0,
        "end_ns": None,
        "read_from_ns": None,
        "read_until_ns": None,
        "destination": "store",
        "on_error": {"session": "report", "message": "log_warn"},
        "quarantine": None,
        "topics": [TOPIC],
        "excluded": [],
        **changes,
    }


def said(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [str(one) for one in differences([old], [new])]


def test_differences_of_equal_plans_are_empty() -> None:
    assert differences([plan()], [plan()]) == ()


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"end_ns": 5}, "s: end_ns: none → 5"),
        ({"metadata": {"a": {"b": 1}}}, 's: + sequence metadata a: {"b": 1}'),
        ({"files": [{"path": "x.bag", "size_bytes": 2}]}, "s: file x.bag size_bytes: 1 → 2"),
        ({"topics": [{**TOPIC, "count": None}]}, "s: topic /a count: 3 → none"),
        ({"topics": []}, "s: - topic /a: p/msg/A by A to O"),
        ({"topics": [{**TOPIC, "definitions": ["bag 01"]}]}, 's: topic /a definitions: ["bag 00"] → ["bag 01"]'),
        ({"excluded": [{"topic": "/b", "msgtype": "B", "count": 0, "why": "no"}]}, "s: + excluded topic /b: no"),
        ({"on_error": {"session": "delete", "message": "log_warn"}}, "s: on_error session: report → delete"),
    ],
)  # fmt: skip
def test_differences_have_one_line_each(changes: dict[str, Any], line: str) -> None:
    assert said(plan(), plan(**changes)) == [line]


def test_differences_match_recordings_by_name_then_files() -> None:
    def at(name: str, file: str) -> dict[str, Any]:
        return plan(name=name, files=[{"path": file, "size_bytes": 1}])

    lines = [
        str(one)
        for one in differences(
            [at("a", "1"), at("b", "2"), at("c", "3")], [at("a", "1"), at("z", "3"), at("y", "9")]
        )
    ]
    assert lines == [
        "b: - recording: 2, 1 topics",
        "c: sequence name: c → z",
        "c: sequence family: c → z",
        "y: + recording: 9, 1 topics",
    ]


CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "metadata": st.dictionaries(st.sampled_from("ab"), st.none() | st.integers() | st.just({"c": None})),
        "end_ns": st.none() | st.integers(0, 2),
        "topics": st.lists(
            st.builds(lambda name, every: {**TOPIC, "target": name, "every": every}, st.sampled_from("ab"), st.integers(1, 2)),
            unique_by=lambda topic: topic["target"],
            max_size=2,
        ),
    },
)  # fmt: skip


@given(CHANGES, CHANGES)
def test_differences_exist_exactly_if_digests_differ(one: dict[str, Any], other: dict[str, Any]) -> None:
    old, new = plan(**one), plan(**other)

    def unordered(document: dict[str, Any]) -> dict[str, Any]:
        return {**document, "topics": sorted(document["topics"], key=str)}

    assert (differences([old], [new]) == ()) is (unordered(old) == unordered(new))
