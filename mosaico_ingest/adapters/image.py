"""The setting `image`: raw images as image files, and back to raw images."""

from __future__ import annotations

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec
from mosaico_ingest.errors import AdapterError, ViewError
from mosaico_ingest.job.fields import ImageSettings
from mosaico_ingest.rosbag.definitions.model import Definition

IMAGE_TAG = "Image"
"""The tag of the ontology type whose rows can be stored as image files."""
_FILES = frozenset({"png", "jpeg", "jpg", "tiff"})
"""Formats whose `data` is an image file."""


class EncodedImageSpec(Struct, frozen=True):
    """Stores the raw images of an adapter as image files; adapters of other ontology types are unchanged."""

    inner: AdapterSpec
    settings: ImageSettings

    @property
    def name(self) -> str:
        """The inner adapter's name."""
        return self.inner.name

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The inner adapter's types."""
        return self.inner.ros_types

    @property
    def default(self) -> bool:
        """Whether the inner adapter is the default of its types."""
        return self.inner.default

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Bind the inner adapter.

        Raises:
            AdapterError: As in the inner adapter.
            IngestError: The format requires Pillow, which is not installed.
        """
        adapter = self.inner.bind(definition, shape)
        if adapter.ontology.tag != IMAGE_TAG:
            return adapter
        from mosaico_ingest.adapters.encoded_images import encoded_images  # noqa: PLC0415 - only this setting needs it

        return encoded_images(adapter, self.settings)


def without_files(rows: pa.StructArray) -> pa.StructArray:
    """Return images as raw buffers; images that are stored as image files are decoded.

    Raises:
        AdapterError: A file is damaged.
        IngestError: Pillow is not installed.
    """
    columns = {field.name: rows.field(field.name) for field in rows.type}
    formats = columns["format"].to_pylist()
    if not _FILES.intersection(formats):
        return rows
    data = [
        _decoded(value.as_py()) if formats[row] in _FILES else memoryview(value.as_buffer())
        for row, value in enumerate(columns["data"])
    ]
    names = ["raw" if name in _FILES else name for name in formats]
    columns["data"] = pa.array(data, rows.type.field("data").type)
    columns["format"] = pa.array(names, rows.type.field("format").type)
    return pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type))


def _decoded(file: bytes) -> bytes:
    from mosaico_ingest.images.files import decoded_buffer  # noqa: PLC0415 - only image files need it

    try:
        return decoded_buffer(file)
    except ViewError as error:
        raise AdapterError(error.what) from error
