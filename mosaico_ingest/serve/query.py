"""Query topics by sequence, metadata and values.

Conditions on values are grouped by ontology tag. A topic fits its tag's group when one of its rows meets all
conditions of the group; a sequence fits when it has such a topic for every group.
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

from mosaico_ingest.destinations.store.errors import explained
from mosaico_ingest.destinations.store.model import SegmentInfo, SequenceInfo, TopicInfo
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve.errors import Deadline, Refusal

__all__ = [
    "MISSING",
    "Comparison",
    "Test",
    "matching_times",
    "run",
    "tests_of",
]

MISSING: Final = object()
"""Where there is no value to ask."""


class Test(Protocol):
    """One condition."""

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - anything that JSON holds, or MISSING
        """Return whether a single value passes."""
        ...

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - numbers or text
        """Return whether a value from `low` to `high` may pass."""
        ...

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the same for a column of that type."""
        ...


_HUGE = 2**1023
"""Whole numbers up to here are some float."""
_GLOB_WORDS = re.compile(r"\[!?\]?[^]]*\]|.", re.DOTALL)
"""A choice in brackets, or one character."""
_COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "$eq": operator.eq,
    "$neq": operator.ne,
    "$lt": operator.lt,
    "$leq": operator.le,
    "$gt": operator.gt,
    "$geq": operator.ge,
}


class Comparison(Struct, frozen=True):
    """`$eq $neq $lt $leq $gt $geq`: how a value stands to another."""

    operator: str
    bound: str | float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value stands so; values of another kind do not."""
        return _alike(value, self.bound) and bool(_COMPARISONS[self.operator](value, self.bound))

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether one end of the span stands so, or the bound lies inside."""
        if self.operator == "$neq" or not _alike(low, self.bound):
            return True
        if self.operator == "$eq":
            return low <= self.bound <= high
        return bool(
            _COMPARISONS[self.operator](low if self.operator in {"$lt", "$leq"} else high, self.bound)
        )

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the comparison."""
        return _compared(self.operator, column, self.bound, kind)


class Outside(Struct, frozen=True):
    """`$outside [low, high]`: below or above."""

    low: float
    high: float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a number outside."""
        return _alike(value, self.low) and bool(value < self.low or value > self.high)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the span reaches outside."""
        return not _alike(low, self.low) or bool(low < self.low or high > self.high)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return both comparisons."""
        return _compared("$lt", column, self.low, kind) | _compared("$gt", column, self.high, kind)


class Choice(Struct, frozen=True):
    """`$in [a, b, …]`: one of them."""

    choices: tuple[str | float, ...]

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is one of them."""
        return any(_alike(value, choice) and value == choice for choice in self.choices)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether one of them lies inside."""
        return any(not _alike(low, choice) or low <= choice <= high for choice in self.choices)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the membership."""
        equal = (_compared("$eq", column, choice, kind) for choice in self.choices)
        return reduce(operator.or_, equal)


class Glob(Struct, frozen=True):
    """`$match pattern`: a whole text, with `*`, `?`, `[…]`, and `#` for a digit."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a text of that form."""
        return isinstance(value, str) and _glob(self.pattern).fullmatch(value) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return that it may."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the match."""
        return pc.match_substring_regex(column, f"^{self._expression()}$")

    def _expression(self) -> str:
        """Return the pattern for Arrow, whose expressions match in linear time and have no look-ahead."""
        return f"(?s:{''.join(map(_spelled, _GLOB_WORDS.findall(self.pattern)))})"


class Like(Struct, frozen=True):
    """`LIKE '%pattern%'` of SQL: text that contains the pattern, with `%` for any text and `_` for any character."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a text that contains the pattern, in any case."""
        return isinstance(value, str) and _like(self.pattern.lower()).fullmatch(value.lower()) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return True."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the same for a column."""
        return pc.match_like(column, f"%{self.pattern}%", ignore_case=True)


@lru_cache(maxsize=256)
def _like(pattern: str) -> re.Pattern[str]:
    glob = re.sub(r"[*?[]", r"[\g<0>]", pattern).replace("%", "*").replace("_", "?")
    return re.compile(translate(f"*{glob}*"))


@lru_cache(maxsize=256)
def _glob(pattern: str) -> re.Pattern[str]:
    """Return the pattern as `fnmatch` translates it, which never backtracks across a `*`."""
    words = _GLOB_WORDS.findall(pattern)
    return re.compile(
        translate("".join("[0-9]" if word == "#" else word.replace("#", "0-9") for word in words))
    )


class Presence(Struct, frozen=True):
    """`$ex`, `$nex`: whether there is a value."""

    wanted: bool

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is there, or is not, as wanted."""
        return (value is not MISSING and value is not None) is self.wanted

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return that it may."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - any type
        """Return the validity."""
        absent = column.is_null()
        return ~absent if self.wanted else absent


def _spelled(word: str) -> str:
    """Return one word of a glob as a regular expression."""
    if word == "*":
        return ".*"
    expression = translate("[0-9]" if word == "#" else word.replace("#", "0-9"))
    return expression[len("(?s:") : -len(r")\Z")].replace("(?!)", r"[^\s\S]")  # nothing, as of [z-a]


def tests_of(conditions: object, *, of: str) -> list[Test]:
    """Return the tests in `{operator: value, …}`, or refuse what is no such thing."""
    if not isinstance(conditions, Mapping):
        raise Refusal(Condition.INVALID, f"{of}: {conditions!r} is not {{operator: value}}")
    return [test for name, operand in conditions.items() for test in _tests(str(name), operand, of)]


def _compared(name: str, column: pc.Expression, bound: str | float, kind: pa.DataType) -> pc.Expression:
    """Return a comparison; whole numbers are compared as such, since Arrow refuses those no float can hold."""
    if pa.types.is_integer(kind) and not isinstance(bound, str | bool):
        return _compared_whole(name, column, bound, kind)
    if isinstance(bound, int) and not isinstance(bound, bool):
        bound = float(bound) if abs(bound) < _HUGE else math.copysign(math.inf, bound)
    compared: pc.Expression = _COMPARISONS[name](column, bound)
    return compared


def _compared_whole(name: str, column: pc.Expression, bound: float, kind: pa.DataType) -> pc.Expression:
    signed = pa.types.is_signed_integer(kind)
    high = 2 ** (kind.bit_width - signed) - 1
    low = -high - 1 if signed else 0

    def above(limit: int) -> pc.Expression:
        if limit < low:
            return column >= pa.scalar(low, kind)
        return column > pa.scalar(min(limit, high), kind)

    if math.isnan(bound):
        return ~above(high) if name == "$neq" else above(high)
    near = max(low - 1, min(bound, high + 1))
    at, below = math.floor(near), math.ceil(near) - 1
    match name:
        case "$gt" | "$leq":
            return above(at) if name == "$gt" else ~above(at)
        case "$geq" | "$lt":
            return above(below) if name == "$geq" else ~above(below)
        case _:
            equal = above(below) & ~above(at)
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
            known = ", ".join([*_COMPARISONS, "$between", "$outside", "$in", "$match", "$ex", "$nex"])
            raise Refusal(Condition.INVALID, f"{of}: {name} {operand!r} is no condition; there are {known}")


def _alike(value: object, bound: object) -> bool:
    """Return whether two values can be compared: both text, or both numbers."""
    if isinstance(value, str) or isinstance(bound, str):
        return isinstance(value, str) and isinstance(bound, str)
    return isinstance(value, int | float)


_WITH_RANGE = "include_timestamp_range"

Tests = Sequence[tuple[str, Test]]
"""What is asked of which field."""


def run(store: Store, question: messages.Query, deadline: Deadline | None = None) -> messages.QueryResult:
    """Return the matching topics by sequence.

    Raises:
        Refusal: The query is invalid, or takes longer than the time limit.
    """
    deadline = deadline or Deadline(math.inf)
    ontology = dict(question.ontology)
    with_range = bool(ontology.pop(_WITH_RANGE, False)) or question.include_timestamp_range
    about_sequence = _about(question.sequence, ("name", "locator", "created_at_ns"), "sequence")
    about_topic = _about(
        question.topic, ("name", "locator", "created_at_ns", "ontology_tag", "serialization_format"), "topic"
    )
    groups = _by_tag(ontology)
    items: list[messages.QueryTopics] = []
    for sequence in store.sequences():
        deadline.check()
        if not _fits(_sequence_values(sequence), sequence.metadata, about_sequence):
            continue
        topics = [each for each in sequence.topics if _fits(_topic_values(each), each.metadata, about_topic)]
        found = (
            _with_values(store, topics, groups, deadline, with_range=with_range) if groups else _all(topics)
        )
        if found or not (groups or about_topic):
            items.append(messages.QueryTopics(sequence=sequence.name, topics=found))
    return messages.QueryResult(items=items)


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
            parsed = tests_of(conditions, of=field)
            tests += [(field, _as_like(test) if field == "locator" else test) for test in parsed]
        else:
            text = f"a {kind} has no {field!r}; ask for {', '.join(fields)} or user_metadata"
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
            raise Refusal(Condition.INVALID, f"{key!r} is not <ontology tag>.<field>")
        groups[tag] += [(path, test) for test in tests_of(conditions, of=key)]
    return dict(groups)


def _sequence_values(sequence: SequenceInfo) -> dict[str, tuple[object, ...]]:
    return {
        "name": (sequence.name,),
        "locator": (sequence.name,),
        "created_at_ns": (sequence.created_ns,),
    }


def _topic_values(topic: TopicInfo) -> dict[str, tuple[object, ...]]:
    """Return what can be asked of a topic; its name goes by three spellings."""
    bare = topic.name.removeprefix("/")
    return {
        "name": (topic.name, bare, messages.topic_locator(topic.sequence, bare)),
        "locator": (messages.topic_locator(topic.sequence, bare),),
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


def _all(topics: Iterable[TopicInfo]) -> list[messages.QueryTopic]:
    return [_item(topic, None) for topic in topics]


def _with_values(
    store: Store,
    topics: Sequence[TopicInfo],
    groups: Mapping[str, Tests],
    deadline: Deadline,
    *,
    with_range: bool,
) -> list[messages.QueryTopic]:
    """Return the topics with a row that fits, or none at all where one tag has no such topic."""
    found: list[messages.QueryTopic] = []
    for tag, tests in groups.items():
        spans = {
            topic.name: _span(store, topic, tests, deadline, whole=with_range)
            for topic in topics
            if topic.ontology.tag == tag
        }
        fitting = [(topic, span) for topic in topics if (span := spans.get(topic.name)) is not None]
        if not fitting:
            return []
        found += [_item(topic, span if with_range else None) for topic, span in fitting]
    return found


def _item(topic: TopicInfo, span: tuple[int, int] | None) -> messages.QueryTopic:
    locator = messages.topic_locator(topic.sequence, topic.name)
    return messages.QueryTopic(locator=locator, ontology_tag=topic.ontology.tag, timestamp_range=span)


def _span(
    store: Store, topic: TopicInfo, tests: Tests, deadline: Deadline, *, whole: bool
) -> tuple[int, int] | None:
    """Return the first and the last matching time stamp, or None; without `whole`, the span of any matching rows."""
    span: tuple[int, int] | None = None
    for times in _matching_batches(store, topic, tests, deadline):
        low, high = int(times.min()), int(times.max())
        span = (low, high) if span is None else (min(span[0], low), max(span[1], high))
        if not whole:
            return span
    return span


def matching_times(
    store: Store,
    topic: TopicInfo,
    ontology: Mapping[str, Any],
    bounds: messages.TimeBounds | None,
    deadline: Deadline,
) -> NDArray[np.int64]:
    """Return the sorted time stamps of a topic's rows that match conditions and lie within `bounds`.

    Raises:
        Refusal: A condition is invalid or concerns another type, or the time limit passes.
    """
    groups = _by_tag({key: value for key, value in ontology.items() if key != _WITH_RANGE})
    if groups.keys() - {topic.ontology.tag}:
        raise Refusal(Condition.INVALID, f"the topic holds {topic.ontology.tag}, not {', '.join(groups)}")
    tests: list[tuple[str, Test]] = list(groups.get(topic.ontology.tag, ()))
    if bounds is not None:
        time = topic.schema.names[0]
        tests += [(time, Comparison("$geq", bounds.start_ns)), (time, Comparison("$leq", bounds.end_ns))]
    batches = list(_matching_batches(store, topic, tests, deadline))
    return np.sort(np.concatenate(batches)) if batches else np.array([], np.int64)


def _matching_batches(
    store: Store, topic: TopicInfo, tests: Tests, deadline: Deadline
) -> Iterator[NDArray[np.int64]]:
    """Yield the time stamps of the rows that pass all tests, segment by segment."""
    condition = _condition(topic.schema, tests)
    if condition is None:
        return
    for segment in _promising(store, topic, tests):
        with explained(segment.path):
            rows = ds.dataset(str(segment.path), schema=topic.schema, format="parquet")
            for batch in rows.to_batches(columns=[topic.schema.names[0]], filter=condition):
                deadline.check()
                if batch.num_rows:
                    yield batch.column(0).to_numpy()


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
