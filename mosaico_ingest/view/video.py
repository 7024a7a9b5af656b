"""Frames of video topics: each row is a packet of the stream, which PyAV decodes from the last key frame on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

import pyarrow as pa

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.images import Pixels
from mosaico_ingest.view.rows import last_rows

_CODECS = {
    **dict.fromkeys(("h264", "avc", "libx264"), "h264"),
    **dict.fromkeys(("hevc", "h265", "libx265"), "hevc"),
    **dict.fromkeys(("av1", "libaom", "libsvtav1", "librav1e"), "av1"),
    "vp8": "vp8",
    "vp9": "vp9",
}
"""Codec by the words of formats and of encoders, such as `h264_nvenc` or `hevc;yuv420p;bgr8`."""
_DECODERS = {"av1": "libdav1d"}
"""FFmpeg's decoder of each codec that does not have the name of the codec; its decoder `av1` needs special hardware."""
_FIRST_PACKETS = 32
"""Number of packets that are searched for a key frame before more are read."""


def video_codec(*formats: object) -> str | None:
    """Return the codec that one of the formats names, such as `h264`, or None if they are not formats of videos."""
    text = " ".join(str(each) for each in formats if each).lower().replace("h.26", "h26")
    return next((_CODECS[word] for word in re.findall("[a-z0-9]+", text) if word in _CODECS), None)


def video_frames(
    topic: TopicInfo, codec: str, times_ns: Sequence[int]
) -> Iterator[tuple[int, Pixels | ViewError]]:
    """Yield the frame of the row at each time as RGB pixels, or the reason why there is none.

    The times are those of rows, in ascending order. Times that depend on the same key frame share the decoded packets.

    Raises:
        IngestError: PyAV is not installed.
    """
    av = _av()
    times_by_key: dict[int, list[int]] = {}
    last_key_ns: int | None = None
    for at, time_ns in enumerate(times_ns):
        key_ns = _last_key_frame(
            av, topic, codec, after_ns=times_ns[at - 1] if at else None, until_ns=time_ns
        )
        last_key_ns = last_key_ns if key_ns is None else key_ns
        if last_key_ns is None:
            yield (
                time_ns,
                ViewError(f"the {codec} video has no key frame until this time", hint="choose a later time"),
            )
        else:
            times_by_key.setdefault(last_key_ns, []).append(time_ns)
    for key_ns, times in times_by_key.items():
        yield from _frames_of_group(av, topic, codec, key_ns, times)


def _last_key_frame(
    av: ModuleType, topic: TopicInfo, codec: str, *, after_ns: int | None, until_ns: int
) -> int | None:
    """Return the time of the last key frame in a range, or None."""
    count = _FIRST_PACKETS
    while True:
        packets = last_rows(topic, count, columns=["data"], end_ns=until_ns)
        for at in reversed(range(packets.num_rows)):
            time_ns, data = (column[at].as_py() for column in packets.columns)
            if after_ns is not None and time_ns <= after_ns:
                return None
            if data and _is_key_frame(av, codec, data):
                return time_ns
        if packets.num_rows < count:
            return None
        count *= 4


def _is_key_frame(av: ModuleType, codec: str, data: bytes) -> bool:
    """Return whether a packet can be decoded without the packets before it."""
    decoder = _decoder(av, codec)
    try:
        return any(frame.key_frame for frame in (*decoder.decode(av.Packet(data)), *decoder.decode(None)))
    except av.FFmpegError:
        return False


def _frames_of_group(
    av: ModuleType, topic: TopicInfo, codec: str, key_ns: int, times_ns: Sequence[int]
) -> Iterator[tuple[int, Pixels | ViewError]]:
    """Yield the frames at times between a key frame and the next one; reordered frames follow in the order of display."""
    decoder = _decoder(av, codec)
    missing = dict.fromkeys(times_ns, "the packet contains no frame")
    for packet in _packets(av, topic, key_ns, times_ns[-1]):
        try:
            frames = decoder.decode(packet)
        except av.FFmpegError as error:
            if packet is not None and packet.pts in missing:
                missing[packet.pts] = str(error)
            continue
        for frame in frames:
            if missing.pop(frame.pts, None) is not None:
                yield frame.pts, frame.to_ndarray(format="rgb24")
    for time_ns, reason in missing.items():
        yield time_ns, ViewError(f"the {codec} frame cannot be decoded: {reason}")


def _packets(av: ModuleType, topic: TopicInfo, start_ns: int, end_ns: int) -> Iterator[Any]:
    """Yield the packets from one time to another, both inclusive, and None, which lets a decoder return its last frames."""
    name = topic.schema.names[0]
    schema = pa.schema([topic.schema.field(name), topic.schema.field("data")])
    for batch in scan(topic.segments, schema, Window(start_ns, end_ns + 1)):
        for time_ns, value in zip(*batch.columns, strict=True):
            data = value.as_py()
            if data:  # an empty packet would end the stream
                packet = av.Packet(data)
                packet.pts = time_ns.as_py()
                yield packet
    yield None


def _decoder(av: ModuleType, codec: str) -> Any:  # noqa: ANN401 - a class of an optional library
    decoder = av.CodecContext.create(_DECODERS.get(codec, codec), "r")
    # Threads of libdav1d need the GIL to release packets, so PyAV deadlocks when it closes a decoder with threads.
    decoder.thread_count = 1
    return decoder


def _av() -> ModuleType:
    try:
        return import_module("av")
    except ImportError as error:
        raise missing_library("PyAV", "video") from error
