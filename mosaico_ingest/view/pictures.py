"""Pictures of rows: images, video frames, and point clouds and occupancy grids from above."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.images import (
    Pixels,
    RawImage,
    color_map,
    demosaic,
    depth_from_inverse,
    depth_parameters,
    depth_payload,
    eight_bits,
    file_samples,
    gray,
    image_file_type,
    is_bayer,
    picture_of,
    pillow,
    raw_pixels,
    run_length_depth,
)
from mosaico_ingest.view.rows import column_schema, last_rows, nearest_row, rows_near

_GAP = 4
"""Pixels between the pictures of a contact sheet."""
_SHEET_BACKGROUND = 32
"""Gray value between the pictures of a contact sheet."""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
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
_NUMPY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""The types of point fields, from code 1 (INT8) to 8 (FLOAT64)."""
_PERCENTILES = (0.5, 99.5)
_BACKGROUND = 18
_GRID = 52
_MARGIN = 0.04
"""Share of the extent that is added on each side."""
_MIN_EXTENT_M = 1.0
_LARGE_PICTURE = 400
_FEW_POINTS = 2_000
_UNKNOWN = 128
_LARGEST_PIXELS = 1 << 26


def has_images(schema: pa.Schema) -> bool:
    """Return whether a topic with these columns contains images: bytes with a pixel encoding or a format."""
    if "data" not in schema.names or not _is_bytes(schema.field("data").type):
        return False
    if "encoding" in schema.names:
        return {"width", "height"} <= set(schema.names)
    return "format" in schema.names


def decode_image(row: Mapping[str, Any], *, ros_format: str = "") -> Pixels:
    """Return the image of a row as RGB pixels of shape (height, width, 3).

    `row` has the columns of `Image` or `CompressedImage`, or the fields of the ROS messages. `ros_format` is the format
    text of a compressed image in the topic's metadata, such as `16UC1; compressedDepth png`. Depth is color-mapped.

    Raises:
        ViewError: The encoding is not supported, or the bytes do not fit it.
        IngestError: Pillow is required and not installed.
    """
    data = row["data"]
    if not isinstance(data, bytes) or not len(data):
        raise ViewError("the row contains no image")
    encoding = row.get("encoding")
    if encoding is None:
        return _compressed_pixels(bytes(data), ros_format)
    if row.get("format") in {None, "", "raw"}:
        return raw_pixels(_raw_image(row, data))
    samples = file_samples(bytes(data))
    if samples.ndim == 2 and samples.dtype == np.uint8:  # noqa: PLR2004 - the buffer, stored as a grayscale picture
        return raw_pixels(_raw_image(row, samples.tobytes()))
    return _sample_pixels(samples, str(encoding))


def fit_pixels(pixels: Pixels, *, width: int, height: int) -> Pixels:
    """Return the picture scaled to fit into `width` x `height`, with its proportions; never enlarged.

    Raises:
        IngestError: Pillow is not installed.
    """
    picture = picture_of(pixels)
    picture.thumbnail((max(1, width), max(1, height)))
    return np.asarray(picture)


def png_bytes(pixels: Pixels) -> bytes:
    """Return the picture as a PNG file.

    Raises:
        IngestError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    picture_of(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def write_picture(pixels: Pixels, path: Path) -> None:
    """Write the picture as PNG, JPEG or WebP, by the suffix of the file.

    Raises:
        ViewError: The suffix is unknown.
        IngestError: Pillow is not installed.
    """
    require_suffix(path, _SUFFIXES)
    picture_of(pixels).save(path)


def require_suffix(path: Path, suffixes: Sequence[str]) -> None:
    """Check that the name of a file has one of the suffixes, in upper or lower case.

    Raises:
        ViewError: The name has another suffix.
    """
    if path.suffix.lower() not in suffixes:
        raise ViewError(
            f"{path.suffix or 'no suffix'} is no supported suffix",
            where=str(path),
            hint=f"use one of {', '.join(suffixes)}",
        )


def contact_sheet(pictures: Sequence[tuple[str, Pixels]], *, columns: int = 4, width: int = 320) -> Pixels:
    """Return one picture with small versions of all pictures in rows, each above its label.

    Raises:
        IngestError: Pillow is not installed.
    """
    image, draw = pillow("Image"), pillow("ImageDraw")
    font = pillow("ImageFont").load_default(size=14)
    thumbnails = [fit_pixels(pixels, width=width, height=width) for _, pixels in pictures]
    label_height = 20
    cell_height = max((each.shape[0] for each in thumbnails), default=0) + label_height + _GAP
    cell_width = max((each.shape[1] for each in thumbnails), default=0) + _GAP
    columns = max(1, min(columns, len(pictures)))
    rows = -(-len(pictures) // columns)
    size = (columns * cell_width + _GAP, rows * cell_height + _GAP)
    sheet = image.new("RGB", size, (_SHEET_BACKGROUND,) * 3)
    pen = draw.Draw(sheet)
    for at, ((label, _), thumbnail) in enumerate(zip(pictures, thumbnails, strict=True)):
        row, column = divmod(at, columns)
        x, y = _GAP + column * cell_width, _GAP + row * cell_height
        sheet.paste(image.fromarray(thumbnail), (x, y))
        pen.text((x, y + cell_height - label_height - _GAP + 2), label, fill=(230,) * 3, font=font)
    return np.asarray(sheet)


def _is_bytes(kind: pa.DataType) -> bool:
    return pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_binary_view(kind)


def _raw_image(row: Mapping[str, Any], data: bytes | memoryview) -> RawImage:
    stride = row.get("stride", row.get("step"))
    return RawImage(
        data,
        width=int(row["width"]),
        height=int(row["height"]),
        stride=int(stride or 0),
        encoding=str(row["encoding"]),
        is_bigendian=bool(row.get("is_bigendian")),
    )


def _compressed_pixels(data: bytes, ros_format: str) -> Pixels:
    """Return the pixels of an image file or of a compressed depth image."""
    encoding = ros_format.partition(";")[0].strip()
    if "compressedDepth" in ros_format or depth_payload(data) is not None:
        return color_map(_compressed_depth(data, encoding, ros_format))
    return _sample_pixels(file_samples(data), encoding)


def _compressed_depth(data: bytes, encoding: str, ros_format: str) -> npt.NDArray[Any]:
    payload = depth_payload(data)
    if payload is not None:
        values = file_samples(payload)
    elif image_file_type(data) is not None:
        return file_samples(data)
    elif "rvl" in ros_format.lower():
        values = run_length_depth(data)
    else:
        raise ViewError("the compressed depth image contains neither PNG nor RVL data")
    return depth_from_inverse(values, depth_parameters(data)) if encoding == "32FC1" else values


def _sample_pixels(samples: npt.NDArray[Any], encoding: str) -> Pixels:
    """Return the samples of an image file as RGB; `encoding` is that of the image before its compression, if known."""
    if samples.ndim == 3:  # noqa: PLR2004 - height, width and channels
        return np.ascontiguousarray(samples[..., :3])
    pattern = is_bayer(encoding)
    if pattern is not None:
        return demosaic(eight_bits(samples), pattern)
    if samples.dtype == np.uint8:
        return gray(samples)
    return gray(eight_bits(samples)) if encoding == "mono16" else color_map(samples)


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
    for batch in scan(topic.segments, column_schema(topic, ["data"]), Window(start_ns, end_ns + 1)):
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


class Points(Struct, frozen=True):
    """Finite points in the sensor's frame, in m."""

    xyz: npt.NDArray[np.float32]
    """Coordinates, of shape (n, 3)."""
    values: npt.NDArray[np.float32] | None = None
    """The intensity of each point, if the sensor reports it."""


def has_points(schema: pa.Schema) -> bool:
    """Return whether the rows of a topic with these columns contain points."""
    names = set(schema.names)
    if {"fields", "point_step", "data"} <= names or {"ranges", "angle_min", "angle_increment"} <= names:
        return True
    if {"x", "y", "z"} <= names:
        return all(pa.types.is_list(schema.field(name).type) for name in "xyz")
    return any(name in names and _is_list_of_points(schema.field(name).type) for name in ("points", "cells"))


def has_grid(schema: pa.Schema) -> bool:
    """Return whether the rows of a topic with these columns are occupancy grids."""
    if not {"info", "data"} <= set(schema.names) or not pa.types.is_list(schema.field("data").type):
        return False
    info = schema.field("info").type
    return pa.types.is_struct(info) and {"width", "height"} <= {field.name for field in info}


def row_points(row: Mapping[str, Any]) -> Points:
    """Return the finite points of a row.

    Raises:
        ViewError: The row contains no points, or its layout is invalid.
    """
    if "point_step" in row:
        return _packed_points(row)
    if "angle_increment" in row:
        return _beam_points(row)
    if isinstance(row.get("x"), Sequence):
        return _finite([row["x"], row["y"], row["z"]], row.get("intensity"))
    for name in ("points", "cells"):
        if name in row:
            points = row[name] or []
            return _finite([[point[axis] for point in points] for axis in "xyz"], None)
    raise ViewError("the row contains no points")


def from_above(points: Points, *, size: int = 800) -> Pixels:
    """Return the points from above, to scale: x points to the right, y points up, colors show the height.

    The picture has at most `size` x `size` pixels. The grid has lines every 1, 2, 5, 10, … m; a few outliers are cropped.
    """
    xy, heights = points.xyz[:, :2].astype(np.float64), points.xyz[:, 2]
    if not len(xy):
        return np.full((size, size, 3), _BACKGROUND, np.uint8)
    low, high = np.percentile(xy, _PERCENTILES, axis=0)
    if (
        np.minimum(np.abs(low), np.abs(high)) <= high - low
    ).all():  # the sensor is near: it belongs into the picture
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    extent = np.maximum(high - low, _MIN_EXTENT_M)
    low, extent = low - _MARGIN * extent, (1 + 2 * _MARGIN) * extent
    scale = (size - 1) / float(extent.max())
    width, height = (int(extent[axis] * scale) + 1 for axis in range(2))
    pixels = np.full((height, width, 3), _BACKGROUND, np.uint8)
    step = grid_step(float(extent.max()))
    for axis, length in ((0, width), (1, height)):
        lines = np.arange(math.ceil(low[axis] / step), math.floor((low[axis] + extent[axis]) / step) + 1)
        at = np.clip(((lines * step - low[axis]) * scale).astype(int), 0, length - 1)
        if axis == 0:
            pixels[:, at] = _GRID
        else:
            pixels[height - 1 - at, :] = _GRID
    at = np.floor((xy - low) * scale).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
    order = np.argsort(heights[inside], kind="stable")  # higher points cover lower ones
    columns, rows = at[inside][order].T
    is_flat = float(np.ptp(heights)) == 0
    shades = np.ones(len(order)) if is_flat else heights[inside][order] - float(heights.min()) + 1
    colors = np.full((len(order), 3), 230, np.uint8) if is_flat else color_map(shades[np.newaxis])[0]
    radius = 1 if size >= _LARGE_PICTURE else 0  # single pixels are hard to see in a large picture
    radius += 2 if len(order) < _FEW_POINTS else 0
    for offset_y in range(radius + 1):
        for offset_x in range(radius + 1):
            pixels[
                np.clip(height - 1 - rows + offset_y, 0, height - 1),
                np.clip(columns + offset_x, 0, width - 1),
            ] = colors
    return pixels


def grid_step(extent_m: float) -> float:
    """Return the distance of grid lines for an extent: 1, 2 or 5 times a power of ten, about ten lines."""
    power = 10.0 ** math.floor(math.log10(extent_m / 10))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= extent_m / 10)


def grid_pixels(row: Mapping[str, Any]) -> Pixels:
    """Return an occupancy grid: free cells are white, occupied cells black, unknown cells gray; y points up.

    Raises:
        ViewError: The number of cells differs from width times height.
    """
    width, height = int(row["info"]["width"]), int(row["info"]["height"])
    cells = np.asarray(row["data"] or [], np.int16)
    if not 0 < width * height <= _LARGEST_PIXELS or cells.size != width * height:
        raise ViewError(f"the grid has {width} x {height} cells, but {cells.size} values")
    shades = np.where(cells < 0, _UNKNOWN, 255 - np.clip(cells, 0, 100) * 255 // 100).astype(np.uint8)
    return gray(np.flipud(shades.reshape(height, width)))


def _is_list_of_points(kind: pa.DataType) -> bool:
    if not pa.types.is_list(kind) or not pa.types.is_struct(kind.value_type):
        return False
    return {"x", "y", "z"} <= {field.name for field in kind.value_type}


def _packed_points(row: Mapping[str, Any]) -> Points:
    """Return the points of a buffer with a layout, as in `sensor_msgs/PointCloud2`."""
    layout = {str(field["name"]): field for field in row["fields"] or ()}
    missing = [axis for axis in "xyz" if axis not in layout]
    if missing:
        raise ViewError(f"the points have no field {missing[0]!r}; they have {', '.join(layout) or 'none'}")
    width, height, step = int(row["width"]), int(row["height"]), int(row["point_step"])
    data = np.frombuffer(row["data"] or b"", np.uint8)
    row_step = int(row["row_step"]) or width * step
    if width * height == 0:
        return Points(np.empty((0, 3), np.float32))
    if step <= 0 or row_step < width * step or data.size < row_step * (height - 1) + width * step:
        raise ViewError(
            f"{width} x {height} points of {step} bytes do not fit into {data.size} bytes with rows of {row_step}"
        )
    order = ">" if row["is_bigendian"] else "<"
    names = [name for name in ("x", "y", "z", "intensity") if name in layout]
    kinds = [f"{order}{_NUMPY_TYPES[int(layout[name]['datatype']) - 1]}" for name in names]
    offsets = [int(layout[name]["offset"]) for name in names]
    if any(at + np.dtype(kind).itemsize > step for at, kind in zip(offsets, kinds, strict=True)):
        raise ViewError(f"a field ends after the {step} bytes of a point")
    point = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    rows = [np.frombuffer(row["data"], point, count=width, offset=line * row_step) for line in range(height)]
    points = rows[0] if height == 1 else np.concatenate(rows)
    return _finite([points[axis] for axis in "xyz"], points["intensity"] if "intensity" in layout else None)


def _beam_points(row: Mapping[str, Any]) -> Points:
    """Return the points of a laser scan; of several echoes the first counts."""
    echoes = [beam.get("echoes") if isinstance(beam, dict) else beam for beam in row["ranges"] or ()]
    firsts = [(echo[0] if echo else math.nan) if isinstance(echo, Sequence) else echo for echo in echoes]
    ranges = np.asarray([math.nan if value is None else value for value in firsts], np.float32)
    valid = (ranges >= row["range_min"]) & (ranges <= row["range_max"])
    angles = row["angle_min"] + np.arange(len(ranges)) * row["angle_increment"]
    values = row.get("intensities")
    usable = (
        isinstance(values, Sequence)
        and len(values) == len(ranges)
        and not isinstance(values[0], Sequence | dict)
    )
    intensities = np.asarray(values, np.float32)[valid] if usable and values is not None else None
    flat = np.zeros(int(valid.sum()), np.float32)
    return _finite(
        [ranges[valid] * np.cos(angles[valid]), ranges[valid] * np.sin(angles[valid]), flat], intensities
    )


def _finite(axes: Sequence[Any], values: Any) -> Points:  # noqa: ANN401 - lists or arrays
    """Return the points whose coordinates are finite."""
    lengths = {len(axis) for axis in axes}
    if len(lengths) > 1:
        raise ViewError(f"the coordinates have different lengths: {', '.join(map(str, sorted(lengths)))}")
    xyz = np.stack([np.asarray(axis, np.float32) for axis in axes], axis=1)
    valid = np.isfinite(xyz).all(axis=1)
    matches = values is not None and len(values) == len(xyz)
    return Points(xyz[valid], np.asarray(values, np.float32)[valid] if matches else None)


class Thumbnail(Struct, frozen=True):
    """A small picture of one row, or the reason why there is none."""

    time_ns: int
    offset_s: float
    """Seconds after the first row of the topic."""
    pixels: Pixels | None
    problem: str | None


def has_pictures(topic: TopicInfo) -> bool:
    """Return whether the rows of a topic can be shown as pictures."""
    return has_images(topic.schema) or has_points(topic.schema) or has_grid(topic.schema)


def row_picture(topic: TopicInfo, row: Mapping[str, Any], *, size: int = 800) -> Pixels:
    """Return the picture of a row as RGB pixels; point clouds have at most `size` x `size` pixels.

    The picture of a packet of a video is its frame, for which the packets since the last key frame are read.

    Raises:
        ViewError: The rows of the topic are no pictures, or this one is invalid.
        IngestError: Pillow or PyAV is required and not installed.
    """
    if has_images(topic.schema):
        codec = row_codec(topic, row)
        if codec is None:
            return decode_image(row, ros_format=_ros_format(topic))
        ((_, picture),) = video_frames(topic, codec, [row[topic.schema.names[0]]])
        if isinstance(picture, ViewError):
            raise picture
        return picture
    if has_points(topic.schema):
        return from_above(row_points(row), size=size)
    if has_grid(topic.schema):
        return grid_pixels(row)
    raise ViewError(
        f"rows of {topic.ontology.tag} are no pictures",
        where=f"{topic.sequence}{topic.name}",
        hint="choose a topic with images, point clouds, laser scans or grids",
    )


def row_codec(topic: TopicInfo, row: Mapping[str, Any]) -> str | None:
    """Return the codec of a packet of a video, such as `h264`, or None for other images."""
    return video_codec(row.get("encoding"), row.get("format"), _ros_format(topic))


def thumbnails(topic: TopicInfo, count: int, *, width: int, height: int) -> list[Thumbnail]:
    """Return pictures of `count` rows at equal distances in time, scaled to fit into `width` x `height`.

    A row that cannot be shown has the reason instead of a picture. Rows are read one after the other.

    Raises:
        ViewError: The rows of the topic are no pictures.
        IngestError: Pillow or PyAV is required and not installed.
    """
    if topic.start_ns is None or topic.end_ns is None:
        return []
    if not has_pictures(topic):
        row_picture(topic, {})
    times_ns = np.linspace(0, topic.end_ns - topic.start_ns, count).round().astype(np.int64) + topic.start_ns
    result: list[Thumbnail] = []
    for time_ns, picture in _pictures(topic, times_ns.tolist(), size=max(width, height)):
        offset_s = (time_ns - topic.start_ns) / 1e9
        if isinstance(picture, ViewError):
            result.append(Thumbnail(time_ns, offset_s, None, str(picture)))
        else:
            pixels = fit_pixels(picture, width=width, height=height)
            result.append(Thumbnail(time_ns, offset_s, pixels, None))
    return sorted(result, key=lambda each: each.time_ns)


def _pictures(
    topic: TopicInfo, times_ns: Sequence[int], *, size: int
) -> Iterator[tuple[int, Pixels | ViewError]]:
    """Yield the time and the picture, or the reason why there is none, of the row nearest to each time."""
    name = topic.schema.names[0]
    row_times: list[int] = rows_near(topic, times_ns, columns=[]).column(name).to_numpy().tolist()
    formats = [each for each in ("encoding", "format") if each in topic.schema.names]
    codec = row_codec(topic, nearest_row(topic, columns=formats) or {}) if has_images(topic.schema) else None
    if codec is not None:
        yield from video_frames(topic, codec, row_times)
        return
    for time_ns in row_times:
        row = nearest_row(topic, time_ns) or {}
        try:
            yield time_ns, row_picture(topic, row, size=size)
        except ViewError as error:
            yield time_ns, error


def _ros_format(topic: TopicInfo) -> str:
    return str(topic.metadata.get("ros_format", ""))
