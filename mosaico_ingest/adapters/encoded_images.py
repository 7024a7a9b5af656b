"""Adapted raw images as image files, encoded on several threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapted, Adapter, Envelope
from mosaico_ingest.errors import ViewError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.images import EncodedImage, RawImage, encode_image, require_pillow
from mosaico_ingest.job.fields import ImageSettings
from mosaico_ingest.ontology.registry import OntologyType

IMAGE_METADATA_KEY = "_image_"
"""Reserved key of topic metadata: the settings, and the encoding and size of the first image before its conversion."""
_MIN_PARALLEL_BYTES = 1 << 20
"""Size of the images of a batch below which threads take longer than they save."""


def encoded_images(inner: Adapter, settings: ImageSettings) -> Adapter:
    """Return the adapter that stores the images of another adapter as image files.

    Raises:
        IngestError: The format requires Pillow, which is not installed.
    """
    if settings.format != "buffer_png":
        require_pillow()
    return _EncodedImages(inner, settings)


class _EncodedImages(Struct, frozen=True):
    inner: Adapter
    settings: ImageSettings

    @property
    def ontology(self) -> OntologyType:
        return self.inner.ontology

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        metadata = self.inner.topic_metadata(first_row)
        if self.settings.format == "buffer_png":
            return metadata  # the pixels are as recorded
        source: dict[str, Any] = {}
        if first_row is not None:
            names = {field.name for field in first_row.type}
            source = {
                f"source_{name}": first_row[name].as_py()
                for name in ("encoding", "width", "height")
                if name in names
            }
        return {**metadata, IMAGE_METADATA_KEY: {**self.settings.used(), **source}}

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        adapted = self.inner.adapt(rows, envelope)
        images = _raw_images(adapted.rows)
        results = _encoded(images, self.settings)
        failures = tuple(
            RowFailure(int(adapted.index[row]), "image-encoding", result.what)
            for row, result in results.items()
            if isinstance(result, ViewError)
        )
        encoded = {row: result for row, result in results.items() if isinstance(result, EncodedImage)}
        adapted = replace(adapted, rows=_with_files(adapted.rows, self.settings, encoded))
        return _without_failed(adapted, failures) if failures else adapted


def _raw_images(rows: pa.StructArray) -> dict[int, RawImage]:
    """Return the images that are not encoded yet, by row."""
    columns = {field.name: rows.field(field.name) for field in rows.type}
    numbers = [columns[name].to_pylist() for name in ("width", "height", "stride")]
    texts = [columns[name].to_pylist() for name in ("format", "encoding", "is_bigendian")]
    images: dict[int, RawImage] = {}
    for row, (buffer, width, height, stride, kind, encoding, is_bigendian) in enumerate(
        zip(columns["data"], *numbers, *texts, strict=True)
    ):
        if kind == "raw":
            data = memoryview(buffer.as_buffer())
            images[row] = RawImage(data, width, height, stride, encoding, bool(is_bigendian))
    return images


def _encoded(
    images: dict[int, RawImage], settings: ImageSettings
) -> dict[int, EncodedImage | ViewError | None]:
    """Return the file of each image, or the reason for its rejection.

    The memory is bounded by the batch, its files, and one converted image per thread.
    """

    def encode(image: RawImage) -> EncodedImage | ViewError | None:
        try:
            return encode_image(image, settings)
        except ViewError as error:
            return error

    threads = min(os.cpu_count() or 1, len(images))
    if threads < 2 or sum(len(image.data) for image in images.values()) < _MIN_PARALLEL_BYTES:  # noqa: PLR2004 - one thread is this one
        return {row: encode(image) for row, image in images.items()}
    with ThreadPoolExecutor(threads, thread_name_prefix="image") as pool:
        return dict(zip(images, pool.map(encode, images.values()), strict=True))


def _with_files(
    rows: pa.StructArray, settings: ImageSettings, encoded: dict[int, EncodedImage]
) -> pa.StructArray:
    """Return the rows with image files in place of their raw images, and the layout to which the files decode."""
    if not encoded:
        return rows
    columns = {field.name: rows.field(field.name) for field in rows.type}
    values = {name: columns[name].to_pylist() for name in _LAYOUT}
    files: list[bytes | memoryview] = [memoryview(value.as_buffer()) for value in columns["data"]]
    name = "jpeg" if settings.format == "jpeg" else "png"
    for row, image in encoded.items():
        files[row] = image.data
        layout = (name, image.encoding, image.width, image.height, image.stride, image.is_bigendian)
        for column, value in zip(_LAYOUT, layout, strict=True):
            values[column][row] = value
    values["data"] = files
    arrays = [
        pa.array(values[field.name], field.type) if field.name in values else columns[field.name]
        for field in rows.type
    ]
    return pa.StructArray.from_arrays(arrays, fields=list(rows.type), mask=None)


_LAYOUT = ("format", "encoding", "width", "height", "stride", "is_bigendian")


def _without_failed(adapted: Adapted, failures: tuple[RowFailure, ...]) -> Adapted:
    """Return the rows that have no failure; failures are in the order of the batch."""
    keep = ~np.isin(adapted.index, [failure.row for failure in failures])
    times = adapted.log_times
    return Adapted(
        adapted.rows.filter(pa.array(keep)),
        adapted.index[keep],
        tuple(sorted((*adapted.failures, *failures), key=lambda failure: failure.row)),
        None if times is None else times[keep],
    )
