"""Every message type of a distro of each generation, and every message of the real recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.decode.decoder import Decoded, Decoder, DictDecoder, RowwiseDecoder, decoder_for
from mosaico_ingest.errors import DecodeError, IngestError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec
from mosaico_ingest.rosbag.encodings.protobuf import ProtobufCodec
from mosaico_ingest.rosbag.recording import open_recording
from mosaico_ingest.rosbag.serialization import Serializer

AssertAgree = Callable[[Sequence[bytes], Definition, Encoding], Decoded]
AssertSame = Callable[[Decoded, Decoded], None]
LARGEST_ROWWISE = 40_000_000


class Values:
    """A source of random values of any type, with short sequences and texts."""

    def __init__(self, definition: Definition, seed: int) -> None:
        self.types = definition.types
        self.random = np.random.default_rng(seed)

    def message(self, name: str) -> dict[str, Any]:
        return {field.name: self.field(field) for field in self.types[name].fields}

    def field(self, field: Field) -> Any:
        if field.container is Container.SCALAR:
            return self.one(field)
        most = min(field.size or 2, 2)
        count = field.size if field.container is Container.ARRAY else int(self.random.integers(0, most + 1))
        return [self.one(field) for _ in range(count)]

    def one(self, field: Field) -> Any:
        if field.is_message:
            return self.message(field.type)
        if field.type in {"string", "wstring"}:
            return "añ漢b"[: self.random.integers(0, 5)]
        if field.type.startswith("float"):
            return float(np.float32(self.random.standard_normal()))
        return bool(self.random.integers(0, 2)) if field.type == "bool" else int(self.random.integers(0, 100))


def types_of(distro: Stores, version: int) -> Iterator[Definition]:
    resolver = TypeResolver(distro)
    for name in sorted(get_typestore(RosbagsStores(distro.value)).fielddefs):
        yield resolver.resolve(name, None, ros_version=version)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distro", "version", "encoding"),
    [(Stores.ROS2_HUMBLE, 2, Encoding.CDR), (Stores.ROS1_NOETIC, 1, Encoding.ROS1)],
)
def test_standard_types_decode_equally_columnar_and_rowwise(
    assert_agree: AssertAgree, distro: Stores, version: int, encoding: Encoding
) -> None:
    for definition in types_of(distro, version):
        serializer = Serializer(definition, encoding)
        values = [Values(definition, seed).message(definition.root) for seed in range(24)]
        payloads = [serializer.from_dict(value) for value in values]
        assert not assert_agree([*payloads, *payloads[:1] * 20], definition, encoding).failures


def batches_of(corpus: Path) -> Iterator[tuple[Connection, MessageBlock]]:
    """Yield the message blocks of every readable recording, with their connections."""
    for line in (corpus / "INDEX.tsv").read_text().splitlines()[1:]:
        path = corpus / line.split("\t")[0]
        try:
            with open_recording(path, resolve=TypeResolver(Stores.ROS2_HUMBLE)) as recording:
                for batch in recording.message_blocks():
                    yield recording.connections[batch.connection], batch
        except IngestError:
            continue


def reference_decoder(connection: Connection, shape: pa.StructType) -> Decoder:
    """Return a decoder that decodes message by message."""
    assert connection.definition is not None
    match connection.encoding:
        case Encoding.PROTOBUF:
            return DictDecoder(shape, ProtobufCodec(connection.definition))
        case Encoding.JSON:
            return DictDecoder(shape, JsonCodec(connection.definition))
        case encoding:
            return RowwiseDecoder(connection.definition, encoding)


@pytest.mark.slow
def test_corpus_messages_decode_equally_columnar_and_rowwise(corpus: Path, assert_same: AssertSame) -> None:
    messages: Counter[Encoding] = Counter()
    for connection, batch in batches_of(corpus):
        try:
            decoder = decoder_for(connection)
        except DecodeError:
            continue
        if connection.definition is None or batch.lengths.sum() > LARGEST_ROWWISE:
            continue
        assert_same(decoder.decode(batch), reference_decoder(connection, decoder.shape).decode(batch))
        messages[connection.encoding] += len(batch)
    assert messages.total() > 100_000
    assert messages[Encoding.PROTOBUF] > 10
    assert messages[Encoding.JSON] > 200
