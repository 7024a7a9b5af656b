"""Exports of the content that a sequence keeps besides rows: metadata records, `custom_data` and attachments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mosaico_ingest.destinations.store.model import AttachmentInfo
from mosaico_ingest.errors import BagError
from mosaico_ingest.export.sources import SourceSequence
from mosaico_ingest.findings import join_names
from mosaico_ingest.job.values import CUSTOM_DATA_KEY, RECORDS_KEY
from mosaico_ingest.rosbag.blocks import Attachment
from mosaico_ingest.rosbag.rosbags_library import AttachmentWriter, RecordingWriter

_READ_BYTES = 1 << 20


def write_kept(source: SourceSequence, writer: RecordingWriter) -> tuple[str, ...]:
    """Write metadata records, `custom_data` and attachments; return one line for each kind that the file cannot contain.

    Raises:
        BagError: An attachment cannot be read.
    """
    omitted: list[str] = []
    records = dict(_pairs(source.metadata, RECORDS_KEY))
    custom_data = {str(key): str(value) for key, value in _entries(source.metadata.get(CUSTOM_DATA_KEY))}
    if isinstance(writer, AttachmentWriter):
        for name, entries in records.items():
            writer.add_metadata(name, entries)
        for attachment in source.attachments:
            writer.add_attachment(_attachment(attachment), _chunks(attachment))
    else:
        if records:
            omitted.append(f"metadata records: {join_names(records)}")
        if source.attachments:
            omitted.append(f"attachments: {join_names(each.name for each in source.attachments)}")
    if custom_data:
        try:
            writer.set_custom_data(custom_data)
        except BagError:
            omitted.append(f"custom_data: {join_names(custom_data)}")
    return tuple(omitted)


def _pairs(metadata: Mapping[str, Any], key: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield the name and the entries of each metadata record; values in another form are ignored."""
    records = metadata.get(key)
    for record in records if isinstance(records, list) else ():
        if isinstance(record, dict) and isinstance(record.get("name"), str):
            yield record["name"], _entries(record.get("entries"))


def _entries(value: object) -> list[tuple[str, str]]:
    pairs = (entry for entry in (value if isinstance(value, list) else ()) if isinstance(entry, list))
    return [(str(pair[0]), str(pair[1])) for pair in pairs if len(pair) == len(("key", "value"))]


def _attachment(info: AttachmentInfo) -> Attachment:
    return Attachment(
        info.name, info.media_type, info.log_ns, info.create_ns, info.stored_bytes, has_crc=True
    )


def _chunks(info: AttachmentInfo) -> Iterator[bytes]:
    try:
        with info.path.open("rb") as file:
            while chunk := file.read(_READ_BYTES):
                yield bytes(chunk)
    except OSError as error:
        raise BagError(f"the attachment cannot be read: {error.strerror}", where=str(info.path)) from error
