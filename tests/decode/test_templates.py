from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mosaico_ingest.decode.layout import LocatedMessages, Payloads, compile_layout
from mosaico_ingest.decode.locate import locate_by_template
from mosaico_ingest.rosbag.blocks import Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.serialization import Serializer

BatchOf = Callable[[Sequence[bytes]], MessageBlock]

NAMES = Definition(
    "test/msg/Names",
    {
        "test/msg/Names": MessageType(
            "test/msg/Names", (Field("names", "string", container=Container.SEQUENCE),)
        )
    },
    Source.BAG,
    "",
    2,
)


def clusters_of(batch_of: BatchOf, values: Sequence[Sequence[str]]) -> list[LocatedMessages]:
    serializer = Serializer(NAMES, Encoding.CDR)
    batch = batch_of([serializer.from_dict({"names": names}) for names in values])
    payloads = Payloads(batch.data, "<", batch.starts + 4, batch.starts + batch.lengths)
    return locate_by_template(compile_layout(NAMES, Encoding.CDR), payloads)


def test_template_equal_lengths_are_one_group(batch_of: BatchOf) -> None:
    (cluster,) = clusters_of(batch_of, [["left", "right"] * 5, ["LEFT", "RIGHT"] * 5] * 50)
    assert cluster.rows.tolist() == list(range(100))


def test_template_equal_size_different_lengths_are_separate_groups(batch_of: BatchOf) -> None:
    one, other = ["ab", "abcdef"] * 5, ["abcdef", "ab"] * 5
    clusters = clusters_of(batch_of, [one, other, other] * 50)
    actual = sorted(cluster.rows.tolist() for cluster in clusters)
    assert actual == [list(range(0, 150, 3)), [row for row in range(150) if row % 3]]


def test_template_different_layouts_are_omitted(batch_of: BatchOf) -> None:
    random = np.random.default_rng(4)
    values = [["x" * size for size in random.integers(0, 40, 6).tolist()] for _ in range(300)]
    assert clusters_of(batch_of, values) == []
