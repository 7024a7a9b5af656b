"""Attachments of recordings: files with a name, a media type and two times, which MCAP files can contain."""

from __future__ import annotations

from msgspec import Struct


class Attachment(Struct, frozen=True):
    """An attachment of a recording; its content is read by `Recording.attachment_chunks`."""

    name: str
    media_type: str
    log_ns: int
    """The time at which the recorder received it, ns since the epoch."""
    create_ns: int
    """The time at which it was created, ns since the epoch; 0 if unknown."""
    size_bytes: int
    has_crc: bool = False
    """Whether the recording has a checksum of the attachment."""
    split: int = 0
    """The number of the split that contains it."""
    offset: int = 0
    """File offset of the content of its record."""
    data_offset: int = 0
    """File offset of its first byte."""
