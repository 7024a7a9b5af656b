"""This file makes the decoder of a channel."""

from __future__ import annotations

from functools import lru_cache

from mosaico_ingest.bag.batch import Channel, Encoding
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.decode.columnar import ColumnarDecoder
from mosaico_ingest.decode.decoder import Decoder
from mosaico_ingest.errors import DecodeError
from mosaico_ingest.frozen import frozen

__all__ = ["decoder_for"]


def decoder_for(channel: Channel) -> Decoder:
    """Return the decoder of a channel's messages.

    Raises:
        DecodeError: The channel is not in a ROS encoding, has no definition, or one without an Arrow shape.
    """
    if channel.encoding is Encoding.OTHER:
        raise DecodeError(
            f"the messages are not in a ROS encoding ({channel.attributes.get('encoding', 'unknown')})",
            rule="encoding",
            where=channel.topic,
        )
    if channel.definition is None:
        raise DecodeError(
            f"no definition of {channel.msgtype}: {channel.problem or 'the recording has none'}",
            rule="definition",
            where=channel.topic,
        )
    return _decoder(_Known(channel.definition), channel.encoding)


@frozen
class _Known:
    """A definition, told from others by what a decoder needs to know of it."""

    definition: Definition

    def __hash__(self) -> int:
        return hash((self.definition.root, self.definition.text))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Known):
            return NotImplemented
        own, others = self.definition, other.definition
        return (own.root, own.ros_version, own.types) == (others.root, others.ros_version, others.types)


@lru_cache(maxsize=128)
def _decoder(known: _Known, encoding: Encoding) -> Decoder:
    """Return a decoder, the same one for each recording of a batch: it remembers nothing of what it decodes."""
    return ColumnarDecoder(known.definition, encoding)
