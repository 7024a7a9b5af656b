"""Reasons of messages that an adapter in Python rejects: the exception, its file and line, and the message."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from functools import lru_cache
from inspect import unwrap
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from pyarrow import types as pt

from mosaico_ingest.findings import RowFailure

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import Envelope
    from mosaico_ingest.adapters.mapping.columns import DataType

_FIELDS = 40
"""Maximum number of fields in a reason."""


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
    for field in shape:
        path, type_ = f"{prefix}{field.name}", field.type
        while pt.is_list(type_) or pt.is_large_list(type_) or pt.is_fixed_size_list(type_):
            path, type_ = f"{path}[]", type_.value_type
        if pt.is_struct(type_) and type_.num_fields:
            yield from _paths(type_, f"{path}.")
        else:
            yield path.removesuffix("[]")
