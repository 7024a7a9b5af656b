"""Query topics by sequence, metadata and values.

Conditions on values are grouped by ontology tag. A topic matches the group of its tag if one of its rows meets all
conditions of the group. A sequence matches if it has such a topic for every group.
"""

from __future__ import annotations

import math
import operator
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import translate
from functools import lru_cache, reduce
from operator import and_
from typing import Any, Final, Protocol, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.destinations.store.files import translate_errors
from mosaico_ingest.destinations.store.model import SegmentInfo, SequenceInfo, TopicInfo
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve.guard import Deadline, Refusal

MISSING: Final = object()
"""The value of a field that does not exist."""
_FLOAT_LIMIT = 2**1023
"""Integers whose absolute value is smaller can be converted to a finite float."""
_GLOB_PARTS = re.compile(r"\[(?:!?\][^]]*|![^]]+|[^]!][^]]*)\]|.", re.DOTALL)
"""A part of a glob: a character class in brackets, or one character."""
_COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "$eq": operator.eq,
    "$neq": operator.ne,
    "$lt": operator.lt,
    "$leq": operator.le,
    "$gt": operator.gt,
    "$geq": operator.ge,
}
_WITH_RANGE = "include_timestamp_range"


class Test(Protocol):
    """A condition on one field."""

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - any JSON value, or MISSING
        """Return whether a single value meets the condition."""
        ...

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - numbers or text
        """Return whether a value from `low` to `high`, both inclusive, may meet the condition."""
        ...

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the condition as an expression on a column of the type `kind`."""
        ...


class Comparison(Struct, frozen=True):
    """`$eq`, `$neq`, `$lt`, `$leq`, `$gt` or `$geq`: a comparison with a bound."""

    operator: str
    bound: str | float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the comparison is true; it is false for values that are not comparable."""
        return _comparable(value, self.bound) and bool(_COMPARISONS[self.operator](value, self.bound))

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the comparison is true for a value of the range; `$neq` is always possible."""
        if self.operator == "$neq" or not _comparable(low, self.bound):
            return True
        if self.operator == "$eq":
            return low <= self.bound <= high
        return bool(
            _COMPARISONS[self.operator](low if self.operator in {"$lt", "$leq"} else high, self.bound)
        )

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the comparison as an expression."""
        return _comparison(self.operator, column, self.bound, kind)


class Outside(Struct, frozen=True):
    """`$outside [low, high]`: a number below `low` or above `high`."""

    low: float
    high: float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a number outside the interval."""
        return _comparable(value, self.low) and bool(value < self.low or value > self.high)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the range extends outside the interval."""
        return not _comparable(low, self.low) or bool(low < self.low or high > self.high)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the disjunction of both comparisons."""
        return _comparison("$lt", column, self.low, kind) | _comparison("$gt", column, self.high, kind)


class Choice(Struct, frozen=True):
    """`$in [a, b, …]`: a value that equals one of the choices."""

    choices: tuple[str | float, ...]

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value equals one of the choices."""
        return any(_comparable(value, choice) and value == choice for choice in self.choices)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether one of the choices lies in the range."""
        return any(not _comparable(low, choice) or low <= choice <= high for choice in self.choices)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the disjunction of one equality per choice."""
        equal = (_comparison("$eq", column, choice, kind) for choice in self.choices)
        return reduce(operator.or_, equal)


class Glob(Struct, frozen=True):
    """`$match pattern`: a string that matches a glob with `*`, `?`, `[…]`, and `#` for a digit."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a string that matches the glob."""
        return isinstance(value, str) and _glob_regex(self.pattern).fullmatch(value) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return True, because the bounds of a range do not exclude a match."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the match as an expression."""
        return pc.match_substring_regex(column, f"^{self._arrow_regex()}$")

    def _arrow_regex(self) -> str:
        """Return the glob as a regular expression for Arrow, whose engine does not support look-ahead."""
        return f"(?s:{''.join(map(_glob_part_regex, _GLOB_PARTS.findall(self.pattern)))})"


class Like(Struct, frozen=True):
    """`LIKE '%pattern%'` of SQL: `%` matches any text, and `_` matches one character."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a string that contains the pattern."""
        return isinstance(value, str) and _like_regex(self.pattern).fullmatch(value) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return True, because the bounds of a range do not exclude a match."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the match as an expression."""
        return pc.match_like(column, f"%{self.pattern}%")


@lru_cache(maxsize=256)
def _like_regex(pattern: str) -> re.Pattern[str]:
    glob = re.sub(r"[*?[]", r"[\g<0>]", pattern).replace("%", "*").replace("_", "?")
    return re.compile(translate(f"*{glob}*"))


@lru_cache(maxsize=256)
def _glob_regex(pattern: str) -> re.Pattern[str]:
    """Return the glob as translated by `fnmatch`, whose expressions never backtrack across a `*`."""
    return re.compile(translate("".join(map(_glob_part, _GLOB_PARTS.findall(pattern)))))


def _glob_part(part: str) -> str:
    """Return one part of a glob in the syntax of `fnmatch`."""
    if part == "#":
        return "[0-9]"
    if part == "[":  # without its "]", and not the start of a class that a later "#" would close
        return "[[]"
    return part.replace("#", "0-9")


class Presence(Struct, frozen=True):
    """`$ex` or `$nex`: a value that exists, or does not exist."""

    wanted: bool

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the existence of the value is as wanted; null counts as missing."""
        return (value is not MISSING and value is not None) is self.wanted

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return True, because the bounds of a range do not exclude a match."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - any type
        """Return the check for null as an expression."""
        absent = column.is_null()
        return ~absent if self.wanted else absent


def _glob_part_regex(part: str) -> str:
    """Return one part of a glob as a regular expression."""
    if part == "*":
        return ".*"
    expression = translate(_glob_part(part))
    # `(?!)` is how `translate` writes an empty class such as [z-a]
    return expression[len("(?s:") : -len(r")\Z")].replace("(?!)", r"[^\s\S]")


def tests_of(conditions: object, *, of: str) -> list[Test]:
    """Return the tests of `{operator: value, …}`, the conditions on the field `of`.

    Raises:
        Refusal: The conditions are not such a mapping, or contain an unknown operator or an invalid operand.
    """
    if not isinstance(conditions, Mapping):
        raise Refusal(Condition.INVALID, f"{of}: {conditions!r} is not a mapping; write {{operator: value}}")
    return [test for name, operand in conditions.items() for test in _tests(str(name), operand, of)]


def _comparison(name: str, column: pc.Expression, bound: str | float, kind: pa.DataType) -> pc.Expression:
    """Return a comparison; integer columns use integer bounds, because Arrow rejects inexact conversions to float."""
    if pa.types.is_integer(kind) and not isinstance(bound, str | bool):
        return _integer_comparison(name, column, bound, kind)
    if isinstance(bound, int) and not isinstance(bound, bool):
        bound = float(bound) if abs(bound) < _FLOAT_LIMIT else math.copysign(math.inf, bound)
    comparison: pc.Expression = _COMPARISONS[name](column, bound)
    return comparison


def _integer_comparison(name: str, column: pc.Expression, bound: float, kind: pa.DataType) -> pc.Expression:
    """Return the comparison of an integer column with any number, which may lie outside the column's type."""
    signed = pa.types.is_signed_integer(kind)
    high = 2 ** (kind.bit_width - signed) - 1
    low = -high - 1 if signed else 0

    def above(limit: int) -> pc.Expression:
        if limit < low:
            return column >= pa.scalar(low, kind)
        return column > pa.scalar(min(limit, high), kind)

    if math.isnan(bound):
        return ~above(high) if name == "$neq" else above(high)
    clamped = max(low - 1, min(bound, high + 1))
    floor, below = math.floor(clamped), math.ceil(clamped) - 1
    match name:
        case "$gt" | "$leq":
            return above(floor) if name == "$gt" else ~above(floor)
        case "$geq" | "$lt":
            return above(below) if name == "$geq" else ~above(below)
        case _:
            equal = above(below) & ~above(floor)
            return equal if name == "$eq" else ~equal


def _tests(name: str, operand: object, of: str) -> list[Test]:
    match name, operand:
        case "$between", [str() | int() | float() as low, str() | int() | float() as high]:
            return [Comparison("$geq", low), Comparison("$leq", high)]
        case "$outside", [int() | float() as low, int() | float() as high]:
            return [Outside(low, high)]
        case "$in", [*choices] if choices and all(isinstance(each, str | int | float) for each in choices):
            return [Choice(tuple(choices))]
        case "$match", str() as pattern:
            return [Glob(pattern)]
        case (("$ex" | "$nex"), _):
            return [Presence(name == "$ex")]
        case _, (str() | int() | float()) as bound if name in _COMPARISONS:
            return [Comparison(name, bound)]
        case _:
            operators = ", ".join([*_COMPARISONS, "$between", "$outside", "$in", "$match", "$ex", "$nex"])
            text = f"{of}: {name} {operand!r} is not a condition; use one of {operators} with a valid operand"
            raise Refusal(Condition.INVALID, text)


def _comparable(value: object, bound: object) -> bool:
    """Return whether two values can be compared: both are strings, or both are numbers."""
    if isinstance(value, str) or isinstance(bound, str):
        return isinstance(value, str) and isinstance(bound, str)
    return isinstance(value, int | float)


Tests = Sequence[tuple[str, Test]]
"""Pairs of a field and a test of its value."""


def run(store: Store, question: messages.Query, deadline: Deadline | None = None) -> messages.QueryResult:
    """Return the matching topics by sequence.

    Raises:
        Refusal: The query is invalid, or takes longer than the time limit.
    """
    deadline = deadline or Deadline(math.inf)
    ontology = dict(question.ontology)
    with_range = bool(ontology.pop(_WITH_RANGE, False)) or question.include_timestamp_range
    sequence_tests = _field_tests(question.sequence, ("name", "locator", "created_at_ns"), "sequence")
    topic_tests = _field_tests(
        question.topic, ("name", "locator", "created_at_ns", "ontology_tag", "serialization_format"), "topic"
    )
    groups = _by_tag(ontology)
    items: list[messages.QueryTopics] = []
    for sequence in store.sequences():
        deadline.check()
        if not _matches(_sequence_values(sequence), sequence.metadata, sequence_tests):
            continue
        topics = [
            each for each in sequence.topics if _matches(_topic_values(each), each.metadata, topic_tests)
        ]
        if groups:
            matches = _matching_topics(store, topics, groups, deadline, with_range=with_range)
        else:
            matches = [_item(topic, None) for topic in topics]
        if matches or not (groups or topic_tests):
            items.append(messages.QueryTopics(sequence=sequence.name, topics=matches))
    return messages.QueryResult(items=items)


def _field_tests(conditions_by_field: Mapping[str, Any], fields: Sequence[str], kind: str) -> Tests:
    """Return the tests of a sequence or topic; fields of the metadata have the prefix `user_metadata.`."""
    tests: list[tuple[str, Test]] = []
    for field, conditions in conditions_by_field.items():
        if field == "user_metadata":
            if not isinstance(conditions, Mapping):
                raise Refusal(
                    Condition.INVALID,
                    f"user_metadata: {conditions!r} is not a mapping; write {{path: conditions}}",
                )
            for path, inner in cast("Mapping[str, Any]", conditions).items():  # keys in JSON are strings
                tests += [(f"user_metadata.{path}", test) for test in tests_of(inner, of=path)]
        elif field in fields:
            field_tests = tests_of(conditions, of=field)
            tests += [(field, _as_like(test) if field == "locator" else test) for test in field_tests]
        else:
            text = f"a {kind} has no field {field!r}; use {', '.join(fields)} or user_metadata"
            raise Refusal(Condition.INVALID, text)
    return tests


def _as_like(test: Test) -> Test:
    """Return `$match` on a locator as `LIKE '%text%'`, as the platform's server evaluates it; keep other tests."""
    return Like(test.pattern) if isinstance(test, Glob) else test


def _by_tag(ontology: Mapping[str, Any]) -> dict[str, Tests]:
    groups: dict[str, list[tuple[str, Test]]] = defaultdict(list)
    for key, conditions in ontology.items():
        tag, _, path = key.partition(".")
        if not path:
            raise Refusal(
                Condition.INVALID, f"{key!r} is not a field of an ontology type; write <ontology tag>.<field>"
            )
        groups[tag] += [(path, test) for test in tests_of(conditions, of=key)]
    return dict(groups)


def _sequence_values(sequence: SequenceInfo) -> dict[str, tuple[object, ...]]:
    return {"name": (sequence.name,), "locator": (sequence.name,), "created_at_ns": (sequence.created_ns,)}


def _topic_values(topic: TopicInfo) -> dict[str, tuple[object, ...]]:
    """Return the values of a topic's fields; clients write its name and its locator in three spellings."""
    bare = topic.name.removeprefix("/")
    spellings = (topic.name, bare, messages.topic_locator(topic.sequence, bare))
    return {
        "name": spellings,
        "locator": spellings,
        "created_at_ns": (topic.created_ns,),
        "ontology_tag": (topic.ontology.tag,),
        "serialization_format": (topic.ontology.serialization_format.value,),
    }


def _matches(values: Mapping[str, tuple[object, ...]], metadata: Mapping[str, Any], tests: Tests) -> bool:
    for field, test in tests:
        candidates = values.get(field) or (_value_at(metadata, field.split(".")[1:]),)
        results = [test.holds(value) for value in candidates]
        if not (all(results) if isinstance(test, Comparison) and test.operator == "$neq" else any(results)):
            return False
    return True


def _value_at(metadata: object, keys: Iterable[str]) -> object:
    for key in keys:
        if not isinstance(metadata, Mapping) or key not in metadata:
            return MISSING
        metadata = metadata[key]
    return metadata


def _matching_topics(
    store: Store,
    topics: Sequence[TopicInfo],
    groups: Mapping[str, Tests],
    deadline: Deadline,
    *,
    with_range: bool,
) -> list[messages.QueryTopic]:
    """Return the topics with a matching row, or an empty list if a tag has no such topic."""
    matches: list[messages.QueryTopic] = []
    for tag, tests in groups.items():
        ranges = {
            topic.name: _matching_range(store, topic, tests, deadline, complete=with_range)
            for topic in topics
            if topic.ontology.tag == tag
        }
        matching = [(topic, times) for topic in topics if (times := ranges.get(topic.name)) is not None]
        if not matching:
            return []
        matches += [_item(topic, times if with_range else None) for topic, times in matching]
    return matches


def _item(topic: TopicInfo, time_range: tuple[int, int] | None) -> messages.QueryTopic:
    locator = messages.topic_locator(topic.sequence, topic.name)
    return messages.QueryTopic(locator=locator, ontology_tag=topic.ontology.tag, timestamp_range=time_range)


def _matching_range(
    store: Store, topic: TopicInfo, tests: Tests, deadline: Deadline, *, complete: bool
) -> tuple[int, int] | None:
    """Return the first and the last timestamp of the matching rows in nanoseconds, or None if no row matches.

    If `complete` is False, the range covers only the first batch with a match.
    """
    time_range: tuple[int, int] | None = None
    for times in _matching_batches(store, topic, tests, deadline):
        low, high = int(times.min()), int(times.max())
        if time_range is not None:
            low, high = min(time_range[0], low), max(time_range[1], high)
        time_range = (low, high)
        if not complete:
            return time_range
    return time_range


def matching_times(
    store: Store,
    topic: TopicInfo,
    ontology: Mapping[str, Any],
    bounds: messages.TimeBounds | None,
    deadline: Deadline,
) -> NDArray[np.int64]:
    """Return the sorted timestamps, in nanoseconds, of the rows of a topic that meet conditions and lie in `bounds`.

    Raises:
        Refusal: A condition is invalid or names another ontology tag, or the time limit is exceeded.
    """
    groups = _by_tag({key: value for key, value in ontology.items() if key != _WITH_RANGE})
    if groups.keys() - {topic.ontology.tag}:
        raise Refusal(Condition.INVALID, f"the topic contains {topic.ontology.tag}, not {', '.join(groups)}")
    tests: list[tuple[str, Test]] = list(groups.get(topic.ontology.tag, ()))
    if bounds is not None:
        time = topic.schema.names[0]
        tests += [(time, Comparison("$geq", bounds.start_ns)), (time, Comparison("$lt", bounds.end_ns))]
    batches = list(_matching_batches(store, topic, tests, deadline))
    return np.sort(np.concatenate(batches)) if batches else np.array([], np.int64)


def _matching_batches(
    store: Store, topic: TopicInfo, tests: Tests, deadline: Deadline
) -> Iterator[NDArray[np.int64]]:
    """Yield the timestamps of the rows that meet all tests, batch by batch."""
    condition = _condition(topic.schema, tests)
    if condition is None:
        return
    for segment in _candidate_segments(store, topic, tests):
        with translate_errors(segment.path):
            rows = ds.dataset(str(segment.path), schema=topic.schema, format="parquet")
            for batch in rows.to_batches(columns=[topic.schema.names[0]], filter=condition):
                deadline.check()
                if batch.num_rows:
                    yield batch.column(0).to_numpy()


def _condition(schema: pa.Schema, tests: Tests) -> pc.Expression | None:
    """Return the tests as one expression, or None if no row can match because a required column is missing."""
    parts: list[pc.Expression] = []
    for path, test in tests:
        kind = _type_at(schema, path)
        if kind is not None:
            parts.append(_column_condition(test, path, kind))
        elif not test.holds(MISSING):
            return None
    return reduce(and_, parts) if parts else pc.scalar(True)  # noqa: FBT003 - the value of an expression


def _column_condition(test: Test, path: str, kind: pa.DataType) -> pc.Expression:
    try:
        condition = test.column(pc.field(*path.split(".")), kind)
        # Evaluating an expression on an empty table reports operations that the type does not support.
        pa.schema([("x", kind)]).empty_table().filter(test.column(pc.field("x"), kind))
    except pa.ArrowException as err:
        raise Refusal(
            Condition.INVALID, f"{path} has the type {kind}, which {test} does not support"
        ) from err
    return condition


def _type_at(schema: pa.Schema, path: str) -> pa.DataType | None:
    """Return the type of the column at a dotted path, or None if the path does not exist."""
    kind: pa.DataType = pa.struct(list(schema))
    for name in path.split("."):
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            raise Refusal(Condition.INVALID, f"{path!r} lies inside a list; queries support no lists")
        if not isinstance(kind, pa.StructType) or kind.get_field_index(name) < 0:
            return None
        kind = kind.field(name).type
    return kind


def _candidate_segments(store: Store, topic: TopicInfo, tests: Tests) -> list[SegmentInfo]:
    """Return the segments whose bounds in the catalog do not exclude a match."""
    bounds = store.bounds(topic, {path for path, _ in tests})

    def may_match(segment: SegmentInfo) -> bool:
        columns = bounds.get(segment.path, {})
        return all(test.may_hold(*columns[path]) for path, test in tests if path in columns)

    return [segment for segment in topic.segments if may_match(segment)]
