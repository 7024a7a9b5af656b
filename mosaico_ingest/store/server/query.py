"""This file finds topics: by their sequence, by what is said of them, and by the values of their rows.

Conditions on values are grouped by ontology tag. A topic fits its tag's group when one of its rows meets all
conditions of the group; a sequence fits when it has such a topic for every group.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from operator import and_
from typing import Any, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.model import SegmentInfo, SequenceInfo, TopicInfo
from mosaico_ingest.store.server.filters import MISSING, Comparison, Test, tests_of
from mosaico_ingest.store.server.refusals import Refusal
from mosaico_ingest.store.store import Store
from mosaico_ingest.wire import bodies
from mosaico_ingest.wire.conditions import Condition

__all__ = ["run"]

_WITH_RANGE = "include_timestamp_range"

Tests = Sequence[tuple[str, Test]]
"""What is asked of which field."""


def run(store: Store, question: bodies.Query) -> bodies.QueryResult:
    """Return the topics that fit, by sequence."""
    ontology = dict(question.ontology)
    with_range = bool(ontology.pop(_WITH_RANGE, False)) or question.include_timestamp_range
    about_sequence = _about(question.sequence, ("name", "created_at_ns"), "sequence")
    about_topic = _about(
        question.topic, ("name", "created_at_ns", "ontology_tag", "serialization_format"), "topic"
    )
    groups = _by_tag(ontology)
    items: list[bodies.QueryTopics] = []
    for sequence in store.sequences():
        if not _fits(_sequence_values(sequence), sequence.metadata, about_sequence):
            continue
        topics = [each for each in sequence.topics if _fits(_topic_values(each), each.metadata, about_topic)]
        found = _with_values(store, topics, groups, with_range=with_range) if groups else _all(topics)
        if found or not (groups or about_topic):
            items.append(bodies.QueryTopics(sequence=sequence.name, topics=found))
    return bodies.QueryResult(items=items)


def _about(asked: Mapping[str, Any], fields: Sequence[str], kind: str) -> Tests:
    """Return the tests on a sequence or topic; a field below `user_metadata` keeps that prefix."""
    tests: list[tuple[str, Test]] = []
    for field, conditions in asked.items():
        if field == "user_metadata":
            if not isinstance(conditions, Mapping):
                raise Refusal(Condition.INVALID, f"user_metadata: {conditions!r} is not {{path: conditions}}")
            for path, inner in cast("Mapping[str, Any]", conditions).items():  # JSON's keys are text
                tests += [(f"user_metadata.{path}", test) for test in tests_of(inner, of=path)]
        elif field in fields:
            tests += [(field, test) for test in tests_of(conditions, of=field)]
        else:
            text = f"a {kind} has no {field!r}; ask for {', '.join(fields)} or user_metadata"
            raise Refusal(Condition.INVALID, text)
    return tests


def _by_tag(ontology: Mapping[str, Any]) -> dict[str, Tests]:
    groups: dict[str, list[tuple[str, Test]]] = defaultdict(list)
    for key, conditions in ontology.items():
        tag, _, path = key.partition(".")
        if not path:
            raise Refusal(Condition.INVALID, f"{key!r} is not <ontology tag>.<field>")
        groups[tag] += [(path, test) for test in tests_of(conditions, of=key)]
    return dict(groups)


def _sequence_values(sequence: SequenceInfo) -> dict[str, tuple[object, ...]]:
    return {"name": (sequence.name,), "created_at_ns": (sequence.created_ns,)}


def _topic_values(topic: TopicInfo) -> dict[str, tuple[object, ...]]:
    """Return what can be asked of a topic; its name goes by three spellings."""
    bare = topic.name.removeprefix("/")
    return {
        "name": (topic.name, bare, bodies.topic_locator(topic.sequence, bare)),
        "created_at_ns": (topic.created_ns,),
        "ontology_tag": (topic.ontology.tag,),
        "serialization_format": (topic.ontology.serialization_format.value,),
    }


def _fits(values: Mapping[str, tuple[object, ...]], metadata: Mapping[str, Any], tests: Tests) -> bool:
    for field, test in tests:
        known = values.get(field) or (_reach(metadata, field.split(".")[1:]),)
        passes = [test.holds(value) for value in known]
        if not (all(passes) if isinstance(test, Comparison) and test.operator == "$neq" else any(passes)):
            return False
    return True


def _reach(metadata: object, keys: Iterable[str]) -> object:
    for key in keys:
        if not isinstance(metadata, Mapping) or key not in metadata:
            return MISSING
        metadata = metadata[key]
    return metadata


def _all(topics: Iterable[TopicInfo]) -> list[bodies.QueryTopic]:
    return [_item(topic, None) for topic in topics]


def _with_values(
    store: Store, topics: Sequence[TopicInfo], groups: Mapping[str, Tests], *, with_range: bool
) -> list[bodies.QueryTopic]:
    """Return the topics with a row that fits, or none at all where one tag has no such topic."""
    found: list[bodies.QueryTopic] = []
    for tag, tests in groups.items():
        spans = {
            topic.name: _span(store, topic, tests, whole=with_range)
            for topic in topics
            if topic.ontology.tag == tag
        }
        fitting = [(topic, span) for topic in topics if (span := spans.get(topic.name)) is not None]
        if not fitting:
            return []
        found += [_item(topic, span if with_range else None) for topic, span in fitting]
    return found


def _item(topic: TopicInfo, span: tuple[int, int] | None) -> bodies.QueryTopic:
    locator = bodies.topic_locator(topic.sequence, topic.name)
    return bodies.QueryTopic(locator=locator, ontology_tag=topic.ontology.tag, timestamp_range=span)


def _span(store: Store, topic: TopicInfo, tests: Tests, *, whole: bool) -> tuple[int, int] | None:
    """Return the first and last time stamp of the rows that fit, None without one; not `whole`: of any that fit."""
    condition = _condition(topic.schema, tests)
    if condition is None:
        return None
    span: tuple[int, int] | None = None
    for segment in _promising(store, topic, tests):
        with explained(segment.path):
            rows = ds.dataset(str(segment.path), schema=topic.schema, format="parquet")
            for batch in rows.to_batches(columns=[topic.schema.names[0]], filter=condition):
                if not batch.num_rows:
                    continue
                times = batch.column(0).to_numpy()
                low, high = int(times.min()), int(times.max())
                span = (low, high) if span is None else (min(span[0], low), max(span[1], high))
                if not whole:
                    return span
    return span


def _condition(schema: pa.Schema, tests: Tests) -> pc.Expression | None:
    """Return the tests as one expression; None where a column that must have a value is not there."""
    parts: list[pc.Expression] = []
    for path, test in tests:
        kind = _type_at(schema, path)
        if kind is not None:
            parts.append(_asked_of_column(test, path, kind))
        elif not test.holds(MISSING):
            return None
    return reduce(and_, parts) if parts else pc.scalar(True)  # noqa: FBT003 - the value of an expression


def _asked_of_column(test: Test, path: str, kind: pa.DataType) -> pc.Expression:
    try:
        asked = test.column(pc.field(*path.split(".")), kind)
        pa.schema([("x", kind)]).empty_table().filter(test.column(pc.field("x"), kind))
    except pa.ArrowException as err:
        raise Refusal(Condition.INVALID, f"{path} is {kind}, which {test} cannot be asked of") from err
    return asked


def _type_at(schema: pa.Schema, path: str) -> pa.DataType | None:
    at: pa.DataType = pa.struct(list(schema))
    for step in path.split("."):
        if pa.types.is_list(at) or pa.types.is_large_list(at) or pa.types.is_fixed_size_list(at):
            raise Refusal(Condition.INVALID, f"{path!r} lies inside a list, which cannot be queried")
        if not isinstance(at, pa.StructType) or at.get_field_index(step) < 0:
            return None
        at = at.field(step).type
    return at


def _promising(store: Store, topic: TopicInfo, tests: Tests) -> list[SegmentInfo]:
    """Return the segments whose bounds in the catalog do not rule a fit out."""
    bounds = store.bounds(topic, {path for path, _ in tests})

    def may_fit(segment: SegmentInfo) -> bool:
        known = bounds.get(segment.path, {})
        return all(test.may_hold(*known[path]) for path, test in tests if path in known)

    return [segment for segment in topic.segments if may_fit(segment)]
