"""Run the tests of an adapter file: adapt the given message and compare the record with the expected one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from pydantic import ValidationError

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.mapping.columns import DataType, pt
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.mapping.model import AdapterTest, MessageProperties, RecordedMessage, records_of
from mosaico_ingest.errors import BagError, IngestError
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Resolver, normalize_msgtype

ReadRecorded: TypeAlias = Callable[[RecordedMessage], "tuple[Definition, pa.StructArray, Envelope]"]
"""Reads one recorded message and returns its definition, a batch of one row in the ROS shape, and its envelope."""

_RELATIVE, _ABSOLUTE = 1e-6, 1e-9
"""Tolerances for numbers: float32 columns keep about seven digits."""


class CaseResult(Struct, frozen=True):
    """The result of one test of an adapter file."""

    name: str
    problems: tuple[str, ...]
    """The differences, one line each; empty if the test passed."""
    line: int
    """The line of the test in the file."""

    @property
    def passed(self) -> bool:
        """Whether the test found no difference."""
        return not self.problems


def run_tests(
    spec: MappingSpec, resolver: Resolver, *, recorded: ReadRecorded | None = None
) -> tuple[CaseResult, ...]:
    """Run all tests of an adapter file; failures are part of the result."""
    outcomes: list[CaseResult] = []
    for position, case in enumerate(spec.model.tests):
        try:
            problems = _run(spec, case, resolver, recorded)
        except IngestError as error:
            problems = [str(error)]
        outcomes.append(CaseResult(case.name, tuple(problems), spec.source.span(("tests", position)).line))
    return tuple(outcomes)


def message_row(given: Mapping[str, Any], shape: DataType) -> tuple[dict[str, Any], list[str]]:
    """Return a message with defaults for missing fields, and the problems of the given values."""
    problems: list[str] = []
    return _with_defaults(given, shape, "", problems), problems


def _run(
    spec: MappingSpec, case: AdapterTest, resolver: Resolver, recorded: ReadRecorded | None
) -> list[str]:
    if case.expect is None and case.rejects is None and not case.drops:
        return ["the test has neither expect nor rejects nor drops"]
    spec = spec.with_parameters(case.parameters) if case.parameters else spec
    if {"bag", "topic"} <= case.given.keys():
        if recorded is None:
            return ["recorded messages cannot be read here"]
        try:
            definition, rows, envelope = recorded(RecordedMessage.model_validate(case.given))
        except ValidationError as error:
            return [f"given: {detail['loc'][-1]}: {detail['msg']}" for detail in error.errors()]
    else:
        definition = _definition(spec, case, resolver)
        shape = ros_shape(definition)
        row, problems = message_row(case.given, shape)
        if problems:
            return problems
        try:
            rows = pa.array([row], shape)
        except (pa.ArrowException, OverflowError, TypeError, ValueError) as error:
            return [f"given does not fit {definition.root}: {error}"]
        envelope = _envelope(case.message or MessageProperties(), definition)
    array = cast("pa.StructArray", rows)  # both branches build it from the struct type of the message
    adapted = spec.bind(definition, rows.type).adapt(array, envelope)
    return _outcome_problems(case, adapted) or _compare(spec, case, adapted)


def _envelope(message: MessageProperties, definition: Definition) -> Envelope:
    published = message.log_time if message.publish_time is None else message.publish_time
    log_times, publish_times, sequences = (
        np.array([value], np.int64) for value in (message.log_time, published, message.sequence)
    )
    return Envelope(message.topic, definition.root, log_times, publish_times, sequences)


def _definition(spec: MappingSpec, case: AdapterTest, resolver: Resolver) -> Definition:
    msgtype = normalize_msgtype(case.ros_type) if case.ros_type else spec.ros_types[0]
    text = spec.own_text(msgtype)
    embedded = Embedded("ros2msg", text) if text else None
    try:
        return resolver.resolve(msgtype, embedded, ros_version=2)
    except BagError as unknown:
        try:
            return resolver.resolve(msgtype, None, ros_version=1)  # Some types exist only in ROS 1.
        except BagError:
            hint = "add its .msg text under `definition`"
            raise BagError(unknown.what, where=unknown.where, hint=hint) from unknown


def _outcome_problems(case: AdapterTest, adapted: Adapted) -> list[str]:
    """Return why the message is not accepted, rejected or dropped as expected."""
    reason = adapted.failures[0].reason if adapted.failures else None
    if reason is not None and case.rejects is None:
        return [f"the row is rejected: {reason}"]
    if case.rejects is not None and case.rejects not in (reason or ""):
        if reason is None:
            return [f"the row is accepted; expected a rejection with {case.rejects!r}"]
        return [f"rejected, but the reason does not contain {case.rejects!r}: {reason}"]
    if bool(adapted.dropped) != bool(case.drops):
        rule = next(iter(adapted.dropped), None)
        return [f"the message is dropped by `{rule}`" if rule else "the message is not dropped"]
    return []


def _compare(spec: MappingSpec, case: AdapterTest, adapted: Adapted) -> list[str]:
    """Return the differences between the rows of a message and the expected ones."""
    problems: list[str] = []
    if case.rejects is not None or case.drops:
        return problems
    outputs = [output.output for output in spec.outputs]
    if not outputs:
        _compare_rows(case.expect, adapted, has_list=spec.model.rows is not None, path="", problems=problems)
        return problems
    if not isinstance(case.expect, Mapping):
        return [f"expect must be a mapping with the outputs {', '.join(outputs)}"]
    problems += [
        f"expect: unknown output {name}; {suggest(name, outputs) or 'there are ' + ', '.join(outputs)}"
        for name in case.expect.keys() - set(outputs)
    ]
    records = records_of(spec.model)
    for name, rows in zip(outputs, (adapted, *adapted.others), strict=True):
        if name in case.expect:
            has_list = records[name].rows is not None
            _compare_rows(case.expect[name], rows, has_list=has_list, path=name, problems=problems)
    return problems


def _compare_rows(expected: Any, adapted: Adapted, *, has_list: bool, path: str, problems: list[str]) -> None:  # noqa: ANN401 - values of a test
    """Compare the rows of one output with the expected record, or with the expected list of records."""
    rows: Any = adapted.rows  # the stubs lack to_pylist of struct arrays
    if has_list or expected is None or isinstance(expected, list):
        _differences(expected or [], rows.to_pylist(), pa.list_(rows.type), path, problems)
    elif len(rows):
        _differences(expected, rows[0].as_py(), rows.type, path, problems)
    else:
        problems.append(f"{path}: expected a row, but there is none")


def _with_defaults(
    given: Mapping[str, Any], shape: DataType, path: str, problems: list[str]
) -> dict[str, Any]:
    names = [field.name for field in shape]
    for name in given:
        if name not in names:
            near = suggest(str(name), names) or f"there are {', '.join(names)}"
            problems.append(f"given: unknown field {path}{name}; {near}")
    return {
        field.name: _value(given.get(field.name), field.type, f"{path}{field.name}", problems)
        for field in shape
    }


def _value(given: Any, type_: DataType, path: str, problems: list[str]) -> Any:  # noqa: ANN401 - values of a message
    if pt.is_struct(type_):
        if given is not None and not isinstance(given, Mapping):
            problems.append(f"given: {path} must be a mapping, not {given!r}")
            given = None
        return _with_defaults(given or {}, type_, f"{path}.", problems)
    if pt.is_fixed_size_list(type_) or pt.is_list(type_):
        default = [None] * type_.list_size if pt.is_fixed_size_list(type_) else []
        items = default if given is None else given
        if not isinstance(items, list):
            problems.append(f"given: {path} must be a list, not {given!r}")
            return default
        return [_value(item, type_.value_type, f"{path}[{i}]", problems) for i, item in enumerate(items)]
    if pt.is_binary(type_):
        return _bytes(given)
    if given is None:
        return "" if pt.is_string(type_) else False if pt.is_boolean(type_) else 0
    return given


def _bytes(given: Any) -> Any:  # noqa: ANN401 - text, a list of numbers, or bytes
    if isinstance(given, str):
        return given.encode()
    return bytes(given or ()) if given is None or isinstance(given, list) else given


def _differences(expected: Any, got: Any, type_: DataType, path: str, problems: list[str]) -> None:  # noqa: ANN401 - values of a record
    where = path.lstrip(".") or "the record"
    if isinstance(expected, Mapping) and pt.is_struct(type_):
        names = [field.name for field in type_]
        for name, value in expected.items():
            if name not in names:
                near = suggest(str(name), names) or f"there are {', '.join(names)}"
                problems.append(f"expect: unknown field {path.lstrip('.')}.{name}; {near}".replace(" .", " "))
            elif got is None:
                if value is not None:
                    problems.append(f"{where}.{name}: expected {value!r}, but {where} is null")
            else:
                _differences(
                    value,
                    got[name],
                    type_.field(type_.get_field_index(name)).type,
                    f"{path}.{name}",
                    problems,
                )
        return
    if isinstance(expected, Sequence) and not isinstance(expected, str) and isinstance(got, list):
        if len(expected) != len(got):
            problems.append(f"{where}: expected {len(expected)} elements, got {len(got)}")
        for position, (one, other) in enumerate(zip(expected, got, strict=False)):
            _differences(one, other, type_.value_type, f"{path}[{position}]", problems)
        return
    if not _same(expected, got):
        problems.append(f"{where}: expected {expected!r}, got {got!r}")


def _same(expected: Any, got: Any) -> bool:  # noqa: ANN401 - values of a record
    if isinstance(got, bytes):
        return _bytes(expected) == got
    if isinstance(expected, bool) or isinstance(got, bool) or expected is None or got is None:
        return expected is got
    if isinstance(expected, (int, float)) and isinstance(got, (int, float)):
        if math.isnan(expected) or math.isnan(got):
            return math.isnan(expected) and math.isnan(got)
        return math.isclose(expected, got, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)
    return bool(expected == got)
