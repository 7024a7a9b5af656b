"""Video topics: the frame of each row is decoded from the last key frame on, for every codec."""

from __future__ import annotations

import sys
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from stored_sequences import IMAGE, ontology

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.errors import IngestError, ViewError
from mosaico_ingest.view import pictures as video
from mosaico_ingest.view.pictures import row_picture, thumbnails, video_codec, video_frames
from mosaico_ingest.view.rows import nearest_row

av: Any = pytest.importorskip("av", reason="PyAV encodes the videos of these tests")

FRAMES, GROUP = 24, 8
"""Number of frames, and the distance of key frames."""
PACKET = ontology(
    "Unmodeled", width=pa.int32(), height=pa.int32(), encoding=pa.string(), pts=pa.uint64(), data=pa.binary()
)
ENCODERS = {
    "h264": ("libx264", {"tune": "zerolatency", "sc_threshold": "0"}),
    "h265": (
        "libx265",
        {"x265-params": f"bframes=0:scenecut=0:keyint={GROUP}:min-keyint={GROUP}:log-level=none"},
    ),
    "av1": ("libsvtav1", {"preset": "12", "svtav1-params": "pred-struct=1"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8"}),
    "reordered": ("libx264", {"bf": "2", "sc_threshold": "0"}),
}


def red(at: int) -> int:
    """Return the red of frame `at`, which is that of no other frame."""
    return at * 10


def encoded(name: str) -> list[tuple[int, bytes]]:
    """Return the number of the frame and the bytes of each packet of a video, in the order of decoding."""
    encoder, options = ENCODERS[name]
    try:
        context = av.CodecContext.create(encoder, "w")
    except ValueError:
        pytest.skip(f"PyAV was built without {encoder}")
    context.width, context.height, context.pix_fmt = 128, 64, "yuv420p"
    context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
    context.gop_size, context.options = GROUP, options
    packets: list[Any] = []
    for at in range(FRAMES):
        pixels = np.zeros((64, 128, 3), np.uint8)
        pixels[..., 0] = red(at)
        pixels[:32, :, 1] = 200  # the top is green, so a flip would be visible
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame.pts = at
        packets += context.encode(frame)
    packets += context.encode(None)
    return [(packet.pts, bytes(packet)) for packet in packets]


def stored(make_store: Any, packets: list[bytes], *, start: int = 0, **columns: object) -> TopicInfo:
    """Return the topic of a video with a packet per ns; `columns` are constant."""
    kind = IMAGE if "format" in columns else PACKET
    rows = [{"timestamp_ns": start + at, "data": data, **columns} for at, data in enumerate(packets)]
    topic: TopicInfo = make_store({"/camera": (kind, rows)}).sequence("made").topic("/camera")
    return topic


def check_frame(pixels: Any, at: int) -> None:
    """Check that pixels are those of frame `at`, upright."""
    assert pixels.shape == (64, 128, 3)
    assert np.abs(pixels[..., 0].mean() - red(at)) < 5  # the distance of two frames is 10
    assert pixels[:24, :, 1].mean() > 180
    assert pixels[40:, :, 1].mean() < 20


@pytest.mark.parametrize("name", ENCODERS)
def test_row_picture_of_packet_is_its_frame(make_store: Any, name: str) -> None:
    frames, packets = zip(*encoded(name), strict=True)
    codec = "h264" if name == "reordered" else name
    topic = stored(make_store, list(packets), format=codec)
    for at in (0, GROUP - 1, GROUP, FRAMES - 1):
        check_frame(row_picture(topic, nearest_row(topic, at) or {}), frames[at])


def test_row_picture_of_packet_of_image_transport_is_its_frame(make_store: Any) -> None:
    _, packets = zip(*encoded("h264"), strict=True)
    columns = {"encoding": "h264;yuv420p;bgr8;bgr8", "width": 128, "height": 64, "pts": 0}
    topic = stored(make_store, list(packets), **columns)
    check_frame(row_picture(topic, nearest_row(topic, 11) or {}), 11)


def test_thumbnails_of_one_key_frame_are_those_of_their_times(make_store: Any) -> None:
    """The only key frame is further away than the packets that are read first."""
    _, packets = zip(*encoded("h264"), strict=True)
    still = [packets[0], *[b""] * 100, *packets[1:GROUP]]
    topic = stored(make_store, still, format="h264")
    shown = thumbnails(topic, 3, width=64, height=64)
    assert [each.time_ns for each in shown] == [0, 54, 107]
    assert [each.problem is None for each in shown] == [True, False, True]
    last = shown[-1].pixels
    assert last is not None
    assert last.shape == (32, 64, 3)
    assert abs(last[..., 0].mean() - red(GROUP - 1)) < 5


def test_video_frames_decodes_each_packet_once(make_store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    _, packets = zip(*encoded("h264"), strict=True)
    topic = stored(make_store, list(packets), format="h264")
    decoded: list[int] = []
    packets_of = video._packets  # the original

    def counted(*arguments: Any) -> Any:
        for packet in packets_of(*arguments):
            decoded.extend([] if packet is None else [packet.pts])
            yield packet

    monkeypatch.setattr(video, "_packets", counted)
    times = [2, 5, GROUP, FRAMES - 1]
    for at, pixels in video_frames(topic, "h264", times):
        check_frame(pixels, at)
    assert decoded == [*range(6), GROUP, *range(2 * GROUP, FRAMES)]


def test_video_frames_before_first_key_frame_state_the_reason(make_store: Any) -> None:
    _, packets = zip(*encoded("h264"), strict=True)
    topic = stored(make_store, list(packets[3:]), start=3, format="h264")
    frames = dict(video_frames(topic, "h264", [3, GROUP - 1, GROUP]))
    assert [type(frame) for frame in frames.values()][:2] == [ViewError, ViewError]
    check_frame(frames[GROUP], GROUP)


@pytest.mark.parametrize("damage", [b"", b"\0\0\0\1damaged"])
def test_video_frames_damaged_packet_costs_its_frame_only_until_next_key_frame(
    make_store: Any, damage: bytes
) -> None:
    _, packets = zip(*encoded("h264"), strict=True)
    topic = stored(make_store, [*packets[:3], damage, *packets[4:]], format="h264")
    frames = dict(video_frames(topic, "h264", [2, 3, GROUP]))
    assert isinstance(frames[3], ViewError)
    check_frame(frames[2], 2)
    check_frame(frames[GROUP], GROUP)


def test_row_picture_without_library_names_the_extra(
    make_store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = stored(make_store, [b"packet"], format="hevc")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(IngestError, match=r"mosaico-ingest\[video\]"):
        row_picture(topic, nearest_row(topic) or {})


@pytest.mark.parametrize(
    ("formats", "codec"),
    [
        (("h264",), "h264"),
        ((None, "H.265"), "hevc"),
        (("raw", "av1"), "av1"),
        (("hevc/bgr8/hevc",), "hevc"),
        (("h264_nvenc",), "h264"),
        (("jpeg", "bgr8; jpeg compressed bgr8"), None),
        (("bayer_rggb8", None), None),
        ((), None),
    ],
)
def test_video_codec_of_formats_is_that_of_the_decoder(formats: tuple[Any, ...], codec: str | None) -> None:
    assert video_codec(*formats) == codec
