"""This file says which rows of two columns differ; NaN equals NaN."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mosaico_ingest.adapters.mapping.arrow import Array, arrays, pc, pt
from mosaico_ingest.adapters.mapping.columns import Mask, field_of, open_list
from mosaico_ingest.adapters.mapping.kinds import is_list

__all__ = ["differences"]


def differences(left: Array, right: Array) -> Mapping[str, Mask]:
    """Return where the fields of two columns of one struct differ, without those that never do."""
    both = ((f.name, ~_same(field_of(left, f.name), field_of(right, f.name))) for f in left.type)
    return {name: wrong for name, wrong in both if wrong.any()}


def _same(left: Array, right: Array) -> Mask:
    absent = np.asarray(left.is_null()), np.asarray(right.is_null())
    equal = absent[0] == absent[1]
    present = np.flatnonzero(~absent[0] & ~absent[1])
    if len(present) < len(left):
        at = arrays.array(present)
        left, right = left.take(at), right.take(at)
    equal[present] = _same_values(left, right)
    return equal


def _same_values(left: Array, right: Array) -> Mask:
    """Compare where neither is null."""
    if pt.is_struct(left.type):
        equal = np.ones(len(left), bool)
        for field in left.type:
            equal &= _same(field_of(left, field.name), field_of(right, field.name))
        return equal
    if is_list(left.type):
        return _same_lists(left, right)
    equal = np.asarray(pc.equal(left, right))
    if pt.is_floating(left.type):
        equal |= np.asarray(pc.and_(pc.is_nan(left), pc.is_nan(right)))
    return equal


def _same_lists(left: Array, right: Array) -> Mask:
    lengths = [open_list(side)[1].lengths for side in (left, right)]
    equal = lengths[0] == lengths[1]
    rows = np.flatnonzero(equal)
    if len(rows) < len(left):
        at = arrays.array(rows)
        left, right = left.take(at), right.take(at)
    values, axis = open_list(left)
    wrong = axis.parents[~_same(values, open_list(right)[0])]
    equal[rows[wrong]] = False
    return equal
