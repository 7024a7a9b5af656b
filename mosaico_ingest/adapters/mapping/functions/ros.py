"""This file is the conventions of ROS messages: headers, covariances, image formats."""

from __future__ import annotations

import re

import numpy as np

from mosaico_ingest.adapters.mapping.arrow import Array, DataType, arrays, pc, pt
from mosaico_ingest.adapters.mapping.columns import (
    Axis,
    Mask,
    field_of,
    fixed_list,
    nulls,
    open_list,
    true_where,
    var_list,
)
from mosaico_ingest.adapters.mapping.functions.lists import NUMBERS
from mosaico_ingest.adapters.mapping.functions.operators import computed
from mosaico_ingest.adapters.mapping.functions.registry import FLOAT, TEXT, Refuse, function, struct_with
from mosaico_ingest.adapters.mapping.functions.time import STAMP, STAMP_TYPE, as_stamp, stamp_parts
from mosaico_ingest.adapters.mapping.kinds import Kind

__all__ = ["HEADER", "HEADER_TYPE", "as_header"]

HEADER_TYPE: DataType = arrays.struct(
    [("timestamp", STAMP_TYPE), ("frame_id", arrays.string()), ("sample_counter", arrays.uint64())]
)


def _is_stamp(type_: DataType) -> bool:
    return STAMP.accepts(Kind(type_))


HEADER = struct_with("a std_msgs/Header", {"stamp": _is_stamp, "frame_id": pt.is_string})
_CODECS = {name: name for name in ("png", "jpeg", "jpg", "tiff", "h264", "hevc", "raw")} | {"h265": "hevc"}


def as_header(refuse: Refuse, h: Array, *, collapse: bool = True) -> Array:
    """Return a `std_msgs/Header` as the ontology's; `collapse`: null where it says nothing."""
    stamp, frame = field_of(h, "stamp"), field_of(h, "frame_id")
    absent = nulls(h)
    if collapse:
        silent = _is_silent(stamp, frame)
        absent = silent if absent is None else absent | silent
    counter = arrays.nulls(len(h), arrays.uint64())
    if h.type.get_field_index("seq") >= 0:
        counter = pc.cast(field_of(h, "seq"), arrays.uint64())
    mask = arrays.array(absent) if absent is not None and absent.any() else None
    children = [as_stamp(refuse, stamp), frame, counter]
    return arrays.StructArray.from_arrays(children, fields=list(HEADER_TYPE), mask=mask)


def _is_silent(stamp: Array, frame: Array) -> Mask:
    unnamed = true_where(pc.equal(pc.binary_length(frame), 0), null=True)
    if not unnamed.any():
        return unnamed
    zero = [true_where(pc.equal(part, 0), null=True) for part in stamp_parts(stamp)]
    return unnamed & zero[0] & zero[1]


@function(HEADER, gives=HEADER_TYPE)
def ros_header(refuse: Refuse, h: Array) -> Array:
    """A std_msgs/Header as the ontology's, ROS 1 `seq` as `sample_counter`; null where frame_id is empty and the stamp zero."""
    return as_header(refuse, h)


def _same(kind: Kind) -> Kind:
    return kind


@function(NUMBERS, gives=_same)
def covariance(c: Array) -> Array:
    """The list, or null unless an element is > 0."""
    elements, axis = open_list(c)
    absent = ~_any_positive(elements, axis)
    if axis.null is not None:
        absent |= axis.null
    if not absent.any():
        return c
    if axis.size is not None:
        return fixed_list(elements, axis.size, absent, len(c))
    return var_list(elements, axis.offsets, absent)


def _any_positive(elements: Array, axis: Axis) -> Mask:
    """Return which lists have an element > 0."""
    rows = len(axis.offsets) - 1
    known = np.zeros(rows, bool)
    if axis.size is None or elements.null_count:
        known[axis.parents[true_where(pc.greater(elements, 0))]] = True
        return known
    for column in np.asarray(elements).reshape(rows, axis.size).T:
        known |= column > 0
        if known.all():
            break
    return known


@function(FLOAT, gives=computed)
def variance(x: Array) -> Array:
    """x, or null unless it is > 0."""
    return pc.if_else(pc.greater(x, 0.0), x, arrays.scalar(None, arrays.float64()))


@function(TEXT, gives=arrays.string())
def compressed_format(s: Array) -> Array:
    """What a CompressedImage's `format` says is inside: png jpeg jpg tiff h264 hevc; raw where it says nothing known."""
    texts = s.dictionary_encode() if not pt.is_null(s.type) else s
    names = arrays.array([_codec(value) for value in texts.dictionary.to_pylist()], arrays.string())
    return names.take(texts.indices)


def _codec(said: str) -> str:
    """Return the codec in a format text, as in `bgr8; jpeg compressed bgr8` or `16UC1; compressedDepth png`.

    Depth without a word behind it, and no text at all, are PNG as the transports' default is.
    """
    words = [word for word in re.split(r"[;,\s]+", said.lower()) if word]
    known = [_CODECS[word] for word in words if word in _CODECS]
    if known:
        return known[0]
    return "png" if not words or words[-1] == "compresseddepth" else "raw"
