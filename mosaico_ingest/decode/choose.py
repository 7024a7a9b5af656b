"""This file makes the decoder of a channel."""

from __future__ import annotations

from mosaico_ingest.bag.batch import Channel, Encoding
from mosaico_ingest.decode.columnar import ColumnarDecoder
from mosaico_ingest.decode.decoder import Decoder
from mosaico_ingest.errors import DecodeError

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
    return ColumnarDecoder(channel.definition, channel.encoding)
