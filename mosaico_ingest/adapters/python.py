"""Adapters written in Python: permission, the base class, the registry of defaults, and their execution.

The environment variable `MOSAICO_NO_PYTHON`, which `ingest --no-python` sets, refuses them for the process and the
processes that it starts; the manifest key `adapters.python` refuses them for one job.
"""

from __future__ import annotations

import os
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from inspect import signature, unwrap
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

import numpy as np
import pyarrow as pa
from msgspec import Struct
from pyarrow import types as pt

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.model import Definition, normalize_msgtype

if TYPE_CHECKING:
    from mosaico_ingest.ontology.model import Header, Message, Serializable
if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import Envelope
    from mosaico_ingest.adapters.mapping.columns import DataType
NO_PYTHON = "MOSAICO_NO_PYTHON"
"""The environment variable that refuses adapters in Python, unless it is empty or `0`."""
_FIELDS = 40
"""Maximum number of fields in a reason."""


def is_python_allowed() -> bool:
    """Return whether this process may run adapters in Python."""
    return os.environ.get(NO_PYTHON, "") in {"", "0"}


def is_python_reference(reference: object) -> bool:
    """Return whether a value of `adapters` is a class, `module:Class` or `file.py:Class`."""
    module, colon, name = str(reference).rpartition(":")
    return isinstance(reference, type) or bool(colon and module and name)


def python_refusal(reference: str) -> tuple[str, str]:
    """Return the message and the hint for a reference to an adapter in Python that is refused."""
    if is_python_allowed():
        return (
            f"{reference} is Python code, which adapters.python refuses",
            "write it as YAML, or allow Python",
        )
    return f"{reference} is Python code, which --no-python refuses", "write it as YAML, or allow Python"


T = TypeVar("T", bound="Serializable")
A = TypeVar("A", bound=type[Any])
_registered: dict[str, type[Any]] = {}


class ROSAdapterBase(ABC, Generic[T]):
    """Base class of adapters in Python: turns messages of `ros_msgtype` into objects of an ontology class.

    An adapter implements `from_dict`, which receives one message. If it also has a classmethod
    `from_batch(rows: pa.StructArray) -> pa.StructArray`, that method receives complete batches of columns instead and
    returns one row of ontology columns per message; a null row rejects its message.
    """

    ros_msgtype: str | tuple[str, ...]
    """The message types that the adapter takes, such as `sensor_msgs/msg/Imu`."""
    __mosaico_ontology_type__: type[Any]
    """The class of the objects that `from_dict` returns."""

    @classmethod
    @abstractmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> T:
        """Return the object for one message, given as a dict of its fields; any exception rejects the message."""
        raise NotImplementedError(f"{cls.__name__} defines neither from_dict nor from_batch")

    @classmethod
    def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:  # noqa: ANN401 - passed on to from_dict
        """Return the object with its time. Override it if the result depends on the topic or time of the message."""
        from mosaico_ingest.ontology.model import Message  # noqa: PLC0415 - the models are slow to import

        convert: Callable[..., T] = cls.from_dict  # An override may accept more arguments.
        return Message(timestamp_ns=ros_msg.bag_timestamp_ns, data=convert(ros_msg.data, **kwargs))

    @classmethod
    def schema_metadata(
        cls,
        ros_data: dict[str, Any],  # noqa: ARG003 - for overrides
        **kwargs: Any,  # noqa: ANN401, ARG003 - for overrides
    ) -> dict[str, Any] | None:
        """Return topic metadata read from the topic's first message; None by default."""
        return None

    @classmethod
    def to_ros(
        cls,
        mosaico_data: Message | T,  # noqa: ARG003 - for overrides
        typestore: Any,  # noqa: ANN401, ARG003 - rosbags' class, which only `rosbag` imports
        ros_msg_type: str | None = None,  # noqa: ARG003 - for overrides
    ) -> Any:  # noqa: ANN401 - a generated class
        """Return the message object of a rosbags typestore for an ontology object. Override it to support exports.

        Raises:
            AdapterError: The adapter does not convert to ROS messages, or not to this type.
        """
        raise AdapterError(
            f"{cls.__name__} does not convert to ROS messages", hint="override to_ros in the adapter"
        )

    @classmethod
    def to_native(cls, mosaico_data: Message | T, **kwargs: Any) -> Any:  # noqa: ANN401 - a generated class
        """Return `to_ros` with keyword arguments, as generic code of the official SDK calls it."""
        return cls.to_ros(mosaico_data, **kwargs)

    @classmethod
    def unpack_mosaico_msg(cls, mosaico_msg: Message | T) -> tuple[T, Header]:
        """Return the ontology object of a message and its header, which is empty if the object has none."""
        from mosaico_ingest.ontology.model import Header, Message, Time  # noqa: PLC0415 - the models are slow to import

        data = cast("T", mosaico_msg.data if isinstance(mosaico_msg, Message) else mosaico_msg)
        header: Header | None = getattr(data, "header", None)
        return data, header or Header(timestamp=Time(seconds=0, nanoseconds=0), frame_id="")

    @classmethod
    def ros_msg_type(cls) -> str | tuple[str, ...]:
        """Return `ros_msgtype`."""
        return cls.ros_msgtype

    @classmethod
    def get_default_ros_msg(cls) -> str:
        """Return the first message type that the adapter takes."""
        return cls.ros_msgtype if isinstance(cls.ros_msgtype, str) else cls.ros_msgtype[0]

    @classmethod
    def is_rosmsg_type_valid(cls, type_to_validate: str) -> bool:
        """Return whether the adapter takes a message type."""
        return normalize_msgtype(type_to_validate) in ros_types_of(cls)

    @classmethod
    def ontology_data_type(cls) -> type[T]:
        """Return the class of the objects that `from_dict` returns."""
        return cls.__mosaico_ontology_type__


@overload
def register_default_adapter(adapter: A) -> A: ...


@overload
def register_default_adapter(adapter: None = None, *, is_default: bool = False) -> Callable[[A], A]: ...


def register_default_adapter(
    adapter: A | None = None,
    *,
    is_default: bool = False,  # noqa: ARG001 - selects the adapter for export in the official SDK
) -> A | Callable[[A], A]:
    """Make an adapter class the default for its types, with precedence over the built-in adapters.

    Use it as a class decorator, with or without parentheses. `is_default` is accepted for compatibility with the
    official SDK; exports find the adapter of a topic in its metadata.

    Raises:
        AdapterError: Another class is already registered for one of the types.
    """
    if adapter is None:
        return _register
    return _register(adapter)


def _register(adapter: A) -> A:
    for msgtype in ros_types_of(adapter):
        other = _registered.get(msgtype)
        if other is not None and _path(other) != _path(adapter):
            raise AdapterError(
                f"{_path(adapter)} and {_path(other)} both register as the default for {msgtype}",
                hint="register one, and name the other in adapter_override for its topics",
            )
        _registered[msgtype] = adapter
    return adapter


def registered_adapters() -> dict[str, type[Any]]:
    """Return the adapter classes registered as defaults, by message type."""
    return dict(_registered)


def ros_types_of(adapter: type[Any]) -> tuple[str, ...]:
    """Return the message types of an adapter class.

    Raises:
        AdapterError: The class has none.
    """
    declared: object = getattr(adapter, "ros_msgtype", None)
    names = (declared,) if isinstance(declared, str) else declared
    if not isinstance(names, (tuple, list)) or not names or not all(isinstance(name, str) for name in names):
        raise AdapterError(
            f"{_path(adapter)} has no ros_msgtype",
            hint='set it to a type such as "my_pkg/msg/MyType", or to a tuple of them',
        )
    return tuple(normalize_msgtype(str(name)) for name in names)


def _path(adapter: type[Any]) -> str:
    return f"{adapter.__module__}.{adapter.__qualname__}"


_BASE = "ROSAdapterBase"
"""Name of the base class of adapters, here and in the official SDK."""
_SDK_FIRST = "typestore"
"""First parameter of `schema_metadata` in newer SDKs, whose result this package derives itself."""
_ROWS_AS_DICTS = 256
"""Messages per batch of Python objects; limits the memory for large messages."""


@dataclass(frozen=True, slots=True)
class PythonAdapterSpec:
    """An adapter class: a subclass of `ROSAdapterBase` of this package or of the official SDK."""

    adapter: type[Any]
    default: bool = True
    origin: tuple[Callable[..., Any], tuple[Any, ...]] | None = field(default=None, compare=False)
    """How another process obtains the spec if the class cannot be imported by its name."""

    @property
    def name(self) -> str:
        """The name of the class."""
        return self.adapter.__name__

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The types in `ros_msgtype`."""
        return ros_types_of(self.adapter)

    def bind(self, definition: Definition, shape: pa.StructType) -> PythonAdapter:  # noqa: ARG002 - a dict has no shape
        """Return the adapter with the columns of its ontology class."""
        model = getattr(self.adapter, "__mosaico_ontology_type__", None)
        if not isinstance(model, type):
            raise AdapterError(
                f"{self.name} has no __mosaico_ontology_type__", hint="set it to the class from_dict returns"
            )
        return PythonAdapter(self.adapter, ontology_of(model))

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Pickle by reference."""
        return self.origin or (PythonAdapterSpec, (self.adapter, self.default))


class PythonAdapter(Struct, frozen=True):
    """Calls an adapter class; an exception rejects the row that raised it."""

    adapter: type[Any]
    ontology: OntologyType

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a batch with `from_batch` if the class has it, else message by message."""
        if hasattr(self.adapter, "from_batch"):
            return self._by_columns(rows, envelope)
        return self._by_messages(rows, envelope)

    @property
    def is_invertible(self) -> bool:
        """Whether the class overrides `to_ros`."""
        return _overrides(self.adapter, "to_ros")

    def to_ros(self, row: dict[str, Any], log_ns: int, typestore: Any, msgtype: str) -> Any:  # noqa: ANN401 - rosbags' class, and a message object
        """Return the message for one row of ontology columns; any exception of the class is passed on."""
        from mosaico_ingest.ontology.model import Message  # noqa: PLC0415 - the models are slow to import

        model = self.adapter.__mosaico_ontology_type__
        # The SDK's models have no from_row.
        data = model.from_row(row) if hasattr(model, "from_row") else model.model_validate(row)
        message = _class_beside_base(self.adapter, "Message", Message)
        return self.adapter.to_ros(message(timestamp_ns=log_ns, data=data), typestore, msgtype)

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return the result of `schema_metadata` for the first message; {} for adapters of the newer SDK.

        Raises:
            AdapterError: `schema_metadata` raised an exception.
        """
        method = getattr(self.adapter, "schema_metadata", None)
        if first_row is None or method is None or _SDK_FIRST in signature(method).parameters:
            return {}
        try:
            return dict(method(first_row.as_py()) or {})
        except Exception as error:
            raise AdapterError(
                f"{self.adapter.__name__}.schema_metadata: {error_text(error)}",
                where=location_of(self.adapter, "schema_metadata", error) or None,
            ) from error

    def _by_columns(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        results = list(self._columns(rows, envelope, first=0))
        failures = tuple(item for item in results if isinstance(item, RowFailure))
        parts = [item for item in results if not isinstance(item, RowFailure)]
        index = [start + np.flatnonzero(part.is_valid()).astype(np.int64) for start, part in parts]
        rejected = [
            self._failure("from_batch returned null", rows, envelope, int(row))
            for start, part in parts
            for row in start + np.flatnonzero(part.is_null())
        ]
        good = [part.drop_null() for _, part in parts]
        return Adapted(
            _joined(good, self.ontology.struct),
            np.concatenate(index) if index else np.empty(0, np.int64),
            tuple(sorted((*failures, *rejected), key=lambda failure: failure.row)),
        )

    def _columns(
        self, rows: pa.StructArray, envelope: Envelope, *, first: int
    ) -> Iterator[RowFailure | tuple[int, pa.StructArray]]:
        """Yield adapted ranges and failed rows in order; a range that raises is halved until the row is found."""
        try:
            result = self.adapter.from_batch(rows)
        except Exception as error:  # noqa: BLE001 - user code may raise anything
            if len(rows) > 1:
                half = len(rows) // 2
                yield from self._columns(rows.slice(0, half), envelope, first=first)
                yield from self._columns(rows.slice(half), envelope, first=first + half)
            else:
                yield self._failure(error, rows, envelope, first)
            return
        yield first, self._checked(result, len(rows))

    def _checked(self, result: object, count: int) -> pa.StructArray:
        row_type = self.ontology.struct
        if isinstance(result, pa.RecordBatch):
            result = result.to_struct_array()
        if not isinstance(result, pa.StructArray) or result.type != row_type or len(result) != count:
            description = (
                f"{len(result)} rows of {result.type}"
                if isinstance(result, pa.Array)
                else type(result).__name__
            )
            raise AdapterError(
                f"{self.adapter.__name__}.from_batch returned {description}, expected {count} rows of {self.ontology.tag}",
                hint=f"return a StructArray of type {row_type}",
            )
        return result

    def _by_messages(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        convert = self._translate if _overrides(self.adapter, "translate") else self._from_dict
        parts: list[_Rows] = []
        for start in range(0, len(rows), _ROWS_AS_DICTS):
            part = _Rows()
            for row, ros_data in enumerate(_as_dicts(rows.slice(start, _ROWS_AS_DICTS)), start):
                try:
                    part.add(row, *convert(ros_data, envelope, row))
                except Exception as error:  # noqa: BLE001, PERF203 - user code may raise anything, for every row
                    part.failures.append(self._failure(error, rows, envelope, row))
            parts.append(part)
        arrays = [self._columns_of(part, rows, envelope) for part in parts]
        index = np.array([row for part in parts for row in part.index], np.int64)
        times = np.array([time for part in parts for time in part.times], np.int64)
        has_new_times = not np.array_equal(times, envelope.log_times[index])
        return Adapted(
            _joined(arrays, self.ontology.struct),
            index,
            tuple(failure for part in parts for failure in part.failures),
            log_times=times if has_new_times else None,
        )

    def _from_dict(
        self, ros_data: dict[str, Any], envelope: Envelope, row: int
    ) -> tuple[int, dict[str, Any]]:
        return int(envelope.log_times[row]), self._row_of(self.adapter.from_dict(ros_data))

    def _translate(
        self, ros_data: dict[str, Any], envelope: Envelope, row: int
    ) -> tuple[int, dict[str, Any]]:
        message = _class_beside_base(self.adapter, "ROSMessage", ROSMessage)(
            bag_timestamp_ns=int(envelope.log_times[row]),
            topic=envelope.topic,
            msg_type=envelope.msgtype,
            data=ros_data,
        )
        translated = self.adapter.translate(message)
        return int(translated.timestamp_ns), self._row_of(translated.data)

    def _row_of(self, value: object) -> dict[str, Any]:
        row_class = self.adapter.__mosaico_ontology_type__
        if not isinstance(value, row_class):
            raise TypeError(f"returned {type(value).__name__}, expected {row_class.__name__}")
        own: Any = value
        return own.to_row() if hasattr(own, "to_row") else own.model_dump()  # the SDK's models have no to_row

    def _columns_of(self, part: _Rows, messages: pa.StructArray, envelope: Envelope) -> pa.StructArray:
        """Convert rows to columns, and move rows that do not fit to the failures."""
        struct = self.ontology.struct
        try:
            return _struct_array(part.rows, struct)
        except _MISFITS:
            for at in reversed(range(len(part.rows))):
                try:
                    _struct_array(part.rows[at : at + 1], struct)
                except _MISFITS as error:  # noqa: PERF203 - runs only for batches that failed
                    part.failures.append(self._failure(error, messages, envelope, part.index[at]))
                    part.drop(at)
            part.failures.sort(key=lambda failure: failure.row)
            return _struct_array(part.rows, struct)

    def _failure(
        self, problem: Exception | str, messages: pa.StructArray, envelope: Envelope, row: int
    ) -> RowFailure:
        method = "from_batch" if hasattr(self.adapter, "from_batch") else "from_dict"
        if method == "from_dict" and _overrides(self.adapter, "translate"):
            method = "translate"
        return rejection(self.adapter, method, problem, row=row, envelope=envelope, shape=messages.type)


_MISFITS = (pa.ArrowException, OverflowError, TypeError, ValueError)


@dataclass(slots=True)
class _Rows:
    """A range of rows as Python objects."""

    index: list[int] = field(default_factory=list[int])
    times: list[int] = field(default_factory=list[int])
    rows: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    failures: list[RowFailure] = field(default_factory=list[RowFailure])

    def add(self, row: int, time: int, values: dict[str, Any]) -> None:
        self.index.append(row)
        self.times.append(time)
        self.rows.append(values)

    def drop(self, at: int) -> None:
        del self.index[at], self.times[at], self.rows[at]


def is_adapter_class(candidate: object) -> bool:
    """Return whether an object is a subclass of `ROSAdapterBase`, of this package or of the SDK."""
    return isinstance(candidate, type) and any(base.__name__ == _BASE for base in candidate.__mro__[1:])


def ontology_of(model: type[Any]) -> OntologyType:
    """Return the ontology type of a model class of this package or of the SDK.

    Raises:
        AdapterError: The class is neither.
    """
    if hasattr(model, "ontology_type"):
        return model.ontology_type()
    struct = getattr(model, "__msco_pyarrow_struct__", None)
    if not isinstance(struct, pa.StructType):
        raise AdapterError(f"{model.__name__} is no ontology class", hint="subclass Serializable")
    layout = getattr(model, "__serialization_format__", SerializationFormat.DEFAULT)
    return OntologyType(model.ontology_tag(), struct, SerializationFormat(layout.value))


def _class_beside_base(adapter: type[Any], name: str, default: Callable[..., Any]) -> Callable[..., Any]:
    """Return a class of the module that defines the adapter's base class, which is the SDK's for its adapters."""
    base = next(base for base in adapter.__mro__ if base.__name__ == _BASE)
    return getattr(sys.modules[base.__module__], name, default)


def _overrides(adapter: type[Any], method: str) -> bool:
    """Return whether the adapter class overrides a method of `ROSAdapterBase`."""
    owner = next((base for base in adapter.__mro__ if method in vars(base)), None)
    return owner is not None and owner.__name__ != _BASE


def _as_dicts(rows: Any) -> list[dict[str, Any]]:  # noqa: ANN401 - the stubs have no to_pylist for structs
    return rows.to_pylist()


def _struct_array(rows: Sequence[dict[str, Any]], struct: pa.StructType) -> pa.StructArray:
    return cast("pa.StructArray", pa.array(rows, type=struct))  # the class follows from the type


def _joined(parts: Sequence[pa.StructArray], struct: pa.StructType) -> pa.StructArray:
    if len(parts) == 1:
        return parts[0]
    return cast("pa.StructArray", pa.concat_arrays(parts) if parts else pa.array([], struct))


def rejection(
    adapter: type[Any],
    method: str,
    problem: Exception | str,
    *,
    row: int,
    envelope: Envelope,
    shape: pa.DataType,
) -> RowFailure:
    """Return the failure of one message of a batch; `problem` is an exception of the method, or the problem in words.

    The reason contains the line of the adapter, the index of the message in its topic, its log time and its fields.
    """
    index = row if envelope.indices is None else int(envelope.indices[row])
    if isinstance(problem, Exception):
        text, location = error_text(problem), location_of(adapter, method, problem)
    else:
        text, location = problem, location_of(adapter, method)
    message = f"message {index}, log time {int(envelope.log_times[row])} ns; fields: {_field_names(shape)}"
    details = f"{location}, {message}" if location else message
    return RowFailure(row, "adapter-rejected", f"{adapter.__name__}: {text} ({details})")


def error_text(error: Exception) -> str:
    """Return an exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def location_of(adapter: type[Any], method: str, error: Exception | None = None) -> str:
    """Return `file:line` of an exception in the files of an adapter class, else of the method; "" if it has no source.

    The deepest line in these files is the location, so the location of an exception in a library is the adapter's call.
    """
    codes = list(_codes(adapter))
    files = {code.co_filename for code in codes}
    frames = traceback.extract_tb(error.__traceback__) if error is not None else []
    lines = [f"{frame.filename}:{frame.lineno}" for frame in frames if frame.filename in files]
    if lines:
        return lines[-1]
    own = next((code for code in codes if code.co_name == method), None)
    return f"{own.co_filename}:{own.co_firstlineno}" if own else ""


def _codes(adapter: type[Any]) -> Iterator[Any]:
    """Yield the code of the methods of an adapter class and its bases, without the bases of this package and the SDK."""
    for owner in adapter.__mro__:
        if owner.__name__ == "ROSAdapterBase":
            return
        for value in vars(owner).values():
            code = getattr(unwrap(getattr(value, "__func__", value)), "__code__", None)
            if code is not None:
                yield code


@lru_cache(maxsize=64)
def _field_names(shape: pa.DataType) -> str:
    """Return the fields of a message type, including nested messages, as adapters access them."""
    names = list(_paths(shape, ""))
    more = f", … ({len(names) - _FIELDS} more)" if len(names) > _FIELDS else ""
    return ", ".join(names[:_FIELDS]) + more if names else "none"


def _paths(shape: DataType, prefix: str) -> Iterator[str]:
    for each in shape:
        path, type_ = f"{prefix}{each.name}", each.type
        while pt.is_list(type_) or pt.is_large_list(type_) or pt.is_fixed_size_list(type_):
            path, type_ = f"{path}[]", type_.value_type
        if pt.is_struct(type_) and type_.num_fields:
            yield from _paths(type_, f"{path}.")
        else:
            yield path.removesuffix("[]")
