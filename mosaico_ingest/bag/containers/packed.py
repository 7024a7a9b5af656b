"""This file inflates messages that rosbag2 compressed one by one; nothing but their first bytes says that it did."""

from __future__ import annotations

import numpy as np

from mosaico_ingest.bag.containers.compression import inflate_message
from mosaico_ingest.bag.containers.magics import ZSTD
from mosaico_ingest.bag.containers.part import Hole, Slab
from mosaico_ingest.bag.containers.slab import stretches
from mosaico_ingest.errors import BagError

__all__ = ["inflate_messages"]

_LIMIT_BYTES = 256 << 20
_MAGIC = np.frombuffer(ZSTD, "<u4")[0]


def inflate_messages(slab: Slab, holes: list[Hole]) -> Slab:
    """Return CDR messages as they were before compression; no CDR message begins as a zstd frame does.

    Whether any is, the first and the last tell; others that are not stay as they are, damaged ones are noted as lost.
    """
    if not (_is_packed(slab, 0) or _is_packed(slab, -1)):
        return slab
    long_enough = slab.lengths >= len(ZSTD)
    heads = stretches(slab.data, slab.starts[long_enough], len(ZSTD)).view("<u4").reshape(-1)
    packed = np.flatnonzero(long_enough)[heads == _MAGIC]
    is_packed = np.zeros(len(slab), np.bool_)
    is_packed[packed] = True
    kept: list[int] = []
    payloads: list[bytes] = []
    for row in range(len(slab)):
        start = int(slab.starts[row])
        payload = slab.data[start : start + int(slab.lengths[row])].tobytes()
        try:
            payloads.append(inflate_message(payload, _LIMIT_BYTES) if is_packed[row] else payload)
        except BagError as err:
            holes.append(Hole(int(slab.offsets[row]), err.what, key=slab.key, count=1))
        else:
            kept.append(row)
    rows = slab.rows(np.array(kept, np.int64))
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return Slab(slab.key, rows.log_times, data, np.cumsum(lengths) - lengths, lengths, rows.offsets)


def _is_packed(slab: Slab, row: int) -> bool:
    start = int(slab.starts[row])
    return slab.data[start : start + min(int(slab.lengths[row]), len(ZSTD))].tobytes() == ZSTD
