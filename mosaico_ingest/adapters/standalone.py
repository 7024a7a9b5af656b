"""Adapters without a recording: single messages, the tests of adapter files, and built-in adapters as classes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, ClassVar, TypeAlias, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from pydantic import ValidationError

from mosaico_ingest.adapters.adapter import Adapted, Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BY_NAME, Builtin
from mosaico_ingest.adapters.inverse import invert
from mosaico_ingest.adapters.mapping.columns import DataType, pt
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.mapping.model import AdapterTest, MessageProperties, RecordedMessage, records_of
from mosaico_ingest.adapters.python import PythonAdapterSpec, ROSAdapterBase, ros_types_of
from mosaico_ingest.errors import AdapterError, BagError, IngestError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.ontology.model import Message, Serializable
from mosaico_ingest.ontology.registry import model
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Resolver, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, ROSTypeRegistry, TypeResolver, store_of
from mosaico_ingest.rosbag.definitions.rosbags_types import definition_in, native_message

ReadRecorded: TypeAlias = Callable[[RecordedMessage], "tuple[Definition, pa.StructArray, Envelope]"]
"""Reads one recorded message and returns its definition, a batch of one row in the ROS shape, and its envelope."""
_RELATIVE, _ABSOLUTE = 1e-6, 1e-9
"""Tolerances for numbers: float32 columns keep about seven digits."""
_DISTROS = (Stores.LATEST, Stores.ROS2_HUMBLE, Stores.ROS2_FOXY, Stores.ROS1_NOETIC)
"""The distros to look up the type of a dict in; the first definition that has all keys of the dict is used."""


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


class DefinitionFinder:
    """Finds definitions by type name; implements `Resolver`."""

    def __init__(
        self,
        distro: Stores | str | None = None,
        custom: Iterable[CustomMessages] = (),
        registry: type[ROSTypeRegistry] = ROSTypeRegistry,
        types: Mapping[str, str] | None = None,
    ) -> None:
        """Look up types in `custom` and `types`, then in `registry`, then in `distro`, by default the newest ROS 2 and ROS 1 Noetic.

        Raises:
            BagError: A definition of `custom` cannot be read, or the distro does not exist.
        """
        store, definitions = store_of(distro), tuple(custom)
        is_ros1 = store is not None and store.value.startswith("ros1")
        self._resolvers = {
            1: TypeResolver(
                store if store and is_ros1 else Stores.ROS1_NOETIC,
                definitions,
                types=types,
                registry=registry,
            ),
            2: TypeResolver(
                store if store and not is_ros1 else Stores.LATEST, definitions, types=types, registry=registry
            ),
        }
        self._first, self._second = (1, 2) if is_ros1 else (2, 1)

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of a type in a version of ROS.

        Raises:
            BagError: The type is unknown in that version.
        """
        return self._resolvers[ros_version].resolve(msgtype, embedded, ros_version=ros_version)

    def find(self, msgtype: str, spec: AdapterSpec | None = None) -> Definition:
        """Return the definition of a type in either version of ROS; the text in an adapter file takes precedence.

        Raises:
            BagError: The type is unknown.
        """
        mapping = mapping_of(spec) if spec else None
        text = mapping.own_text(msgtype) if mapping else None
        embedded = Embedded("ros2msg", text) if text else None
        try:
            return self.resolve(msgtype, embedded, ros_version=self._first)
        except BagError as unknown:
            try:
                return self.resolve(msgtype, embedded, ros_version=self._second)
            except BagError:
                raise unknown from None


def mapping_of(spec: AdapterSpec) -> MappingSpec | None:
    """Return the mapping of an adapter, None for an adapter in Python."""
    if isinstance(spec, Builtin):
        return spec.mapping
    return spec if isinstance(spec, MappingSpec) else None


def translate(spec: AdapterSpec, msg: ROSMessage) -> Message:
    """Return the ontology object and the time of one message.

    Raises:
        AdapterError: The message does not fit.
    """
    if isinstance(spec, PythonAdapterSpec):
        return spec.adapter.translate(msg)
    data = adapt_dict(spec, msg.data, msg.msg_type)
    return Message(timestamp_ns=msg.bag_timestamp_ns, data=data)


def adapt_dict(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> Serializable:
    """Return the ontology object for a dict of fields; among several types, the first that has all keys is used.

    Raises:
        AdapterError: A field is unknown or missing, or a value does not fit.
    """
    adapter, rows, name = _bind(spec, ros_data, msgtype)
    adapted = adapter.adapt(rows, Envelope("", name, np.zeros(1, np.int64)))
    if adapted.failures:
        raise AdapterError(f"{spec.name}: {adapted.failures[0].reason}")
    return model(adapter.ontology.tag).from_row(cast("dict[str, Any]", adapted.rows[0].as_py()))


def metadata_of(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> dict[str, Any]:
    """Return the topic metadata of a first message."""
    adapter, rows, _ = _bind(spec, ros_data, msgtype)
    return adapter.topic_metadata(rows[0])


def _bind(
    spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None
) -> tuple[Adapter, pa.StructArray, str]:
    names = () if msgtype is None else (normalize_msgtype(msgtype),)
    problems: list[str] = []
    for definition in _candidates(spec, names):
        shape = ros_shape(definition)
        unknown = next(_unknown(ros_data, shape, ""), None)
        if unknown is None:
            return spec.bind(definition, shape), _row(ros_data, shape, spec.name), definition.root
        problems.append(f"{definition.root} has no field {unknown}")
    unknown_types = f"no distro defines {', '.join(names or spec.ros_types)}"
    raise AdapterError(f"{spec.name}: {problems[0] if problems else unknown_types}")


def _candidates(spec: AdapterSpec, names: tuple[str, ...]) -> Iterator[Definition]:
    """Yield the definitions that a dict may have: its own type in all distros, then the adapter's other types."""
    mapping = mapping_of(spec)
    for name in dict.fromkeys((*names, *spec.ros_types)):
        yield from _versions(name, mapping.own_text(name) if mapping else None)


@cache
def _versions(msgtype: str, text: str | None) -> tuple[Definition, ...]:
    """Return the definitions of a type in all distros, or in an adapter's own text."""
    definitions: list[Definition] = []
    for distro in _DISTROS:
        version = 1 if distro is Stores.ROS1_NOETIC else 2
        types = {msgtype: text} if text else None
        with suppress(BagError):
            definitions.append(TypeResolver(distro, types=types).resolve(msgtype, None, ros_version=version))
    return tuple(definitions)


def _unknown(ros_data: Mapping[str, Any], shape: pa.StructType, where: str) -> Iterator[str]:
    """Yield the keys that are not fields, including nested keys."""
    fields = {field.name: field.type for field in shape}
    for name, value in ros_data.items():
        if name not in fields:
            yield f"{where}{name}"
            continue
        kind: Any = fields[name]
        items = value if isinstance(value, (list, tuple)) else (value,)
        kind = kind.value_type if hasattr(kind, "value_type") else kind
        if pa.types.is_struct(kind):
            for item in items:
                if isinstance(item, Mapping):
                    yield from _unknown(cast("Mapping[str, Any]", item), kind, f"{where}{name}.")


def _row(ros_data: Mapping[str, Any], shape: pa.StructType, name: str) -> pa.StructArray:
    try:
        return cast("pa.StructArray", pa.array([ros_data], shape))
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise AdapterError(f"{name}: {error}") from error


class CatalogAdapter(ROSAdapterBase[Serializable]):
    """A built-in adapter as a class, for overrides, single messages and subclasses."""

    __adapter_spec__: ClassVar[Builtin]

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> Serializable:
        """Return the ontology object for the fields of one message.

        Raises:
            AdapterError: A field is unknown or missing, or a value does not fit.
        """
        return adapt_dict(cls.__adapter_spec__, ros_data)

    @classmethod
    def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:  # noqa: ANN401 - the base's
        """Return the object with its time, read as the message's own type."""
        if "__adapter_spec__" in vars(cls):
            return translate(cls.__adapter_spec__, ros_msg)
        return super().translate(ros_msg, **kwargs)

    @classmethod
    def schema_metadata(
        cls,
        ros_data: dict[str, Any],
        **kwargs: Any,  # noqa: ANN401, ARG003 - the base's
    ) -> dict[str, Any] | None:
        """Return the topic metadata of a first message."""
        return metadata_of(cls.__adapter_spec__, ros_data) or None

    @classmethod
    def to_ros(
        cls,
        mosaico_data: Message | Serializable,
        typestore: Any,  # noqa: ANN401 - rosbags' class, which only `rosbag` imports
        ros_msg_type: str | None = None,
    ) -> Any:  # noqa: ANN401 - a generated class
        """Return the message object of a rosbags typestore for an ontology object; restores as the export does.

        Raises:
            AdapterError: The adapter does not take the type, or the object is of another ontology type.
            BagError: The typestore does not have the type.
        """
        msgtype = normalize_msgtype(ros_msg_type or cls.get_default_ros_msg())
        data, _ = cls.unpack_mosaico_msg(mosaico_data)
        if not cls.is_rosmsg_type_valid(msgtype) or not isinstance(data, cls.__mosaico_ontology_type__):
            raise AdapterError(
                f"{cls.__name__} does not convert {type(data).__name__} to {msgtype}",
                hint=f"it converts {cls.__mosaico_ontology_type__.__name__} to {', '.join(ros_types_of(cls))}",
            )
        definition = definition_in(typestore, msgtype)
        adapter = cls.__adapter_spec__.bind(definition, ros_shape(definition))
        row = cast("pa.StructArray", pa.array([data.to_row()], adapter.ontology.struct))
        restored = invert(adapter, definition, {}).restore(row, Envelope("", msgtype, np.zeros(1, np.int64)))
        return native_message(typestore, msgtype, cast("dict[str, Any]", restored.rows[0].as_py()))


@cache
def adapter_class(name: str) -> type[CatalogAdapter]:
    """Return the class of a built-in adapter by name; raises KeyError if there is none."""
    builtin = BY_NAME[name]
    members = {
        "__doc__": builtin.mapping.model.description,
        "__module__": __package__,
        "__adapter_spec__": builtin,
        "__mosaico_ontology_type__": model(builtin.tag),
        "ros_msgtype": builtin.ros_types,
    }
    return type(name, (CatalogAdapter,), members)


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
