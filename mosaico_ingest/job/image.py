"""The settings of stored images."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from mosaico_ingest.job.section import Count, Section

ImageFormat = Literal["raw", "png", "jpeg", "buffer_png"]
"""The formats of stored images."""
_FORMATS = {"quality": ("jpeg",), "max_width": ("png", "jpeg"), "depth_unit": ("png",)}
"""The formats that each key affects."""


class ImageSettings(Section):
    """The format of stored raw images. Compressed images and video keep their bytes."""

    format: ImageFormat = "raw"
    """The format: `raw` (as recorded), `png` (a lossless picture), `jpeg`, or `buffer_png` (the bytes of the image as a gray PNG,
    for every encoding, as the official bridge stores them)."""
    quality: Annotated[int, Field(ge=1, le=100)] = 90
    """The quality of JPEG files, from 1 to 100."""
    max_width: Count | None = Field(default=None, examples=[1280])
    """The maximum width in pixels; wider images are scaled down and keep their proportions."""
    depth_unit: Annotated[float, Field(gt=0, le=1)] = 0.001
    """The step in meters at which `png` stores depth images of floating-point numbers in 16 bits."""

    def used(self) -> dict[str, Any]:
        """Return the settings that are set and that affect the format."""
        values = {key: getattr(self, key) for key, formats in _FORMATS.items() if self.format in formats}
        return {"format": self.format, **{key: value for key, value in values.items() if value is not None}}

    @model_validator(mode="after")
    def _check_format(self) -> ImageSettings:
        for key, formats in _FORMATS.items():
            if key in self.model_fields_set and self.format not in formats:
                names = " or ".join(formats)
                message = f"{key} requires format: {names}, but format is {self.format}"
                raise PydanticCustomError("conflicting-keys", "{message}", {"key": key, "message": message})
        return self


def image_settings(value: ImageSettings | ImageFormat) -> ImageSettings:
    """Return the settings of `topic_settings.<topic>.image`, which may be only a format."""
    return ImageSettings(format=value) if isinstance(value, str) else value
