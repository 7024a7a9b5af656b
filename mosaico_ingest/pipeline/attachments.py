"""Content of a recording, besides messages, that its sequence keeps: metadata records, `custom_data` and attachments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any, cast

from msgspec import Struct

from mosaico_ingest.destinations.base import AttachableSession, Attached, Session, destination_of
from mosaico_ingest.errors import BagError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.report.events import Noted, Observer
from mosaico_ingest.report.units import bytes_text, counted
from mosaico_ingest.rosbag.attachments import Attachment
from mosaico_ingest.rosbag.recording import DAMAGE_HELP, Recording

RECORDS_KEY = "_records_"
"""Key of sequence metadata: the metadata records, each with its name and a list of keys and values."""
CUSTOM_DATA_KEY = "_custom_data_"
"""Key of sequence metadata: the `custom_data` of rosbag2, as a list of keys and values."""
_ROSBAG2_RECORD = "rosbag2"
"""The metadata record with a copy of `metadata.yaml`, whose content exports write again."""


class KeptContent(Struct, frozen=True):
    """The metadata and attachments that a plan keeps of a recording."""

    metadata: Mapping[str, Any]
    """Metadata of the sequence, under reserved keys."""
    attachments: tuple[Attachment, ...]
    findings: tuple[Finding, ...]


def kept_content(job: Job, recording: Recording) -> KeptContent:
    """Select the metadata and attachments that the sequence keeps, according to `sequence.keep`.

    Raises:
        BagError: The file cannot be read.
    """
    keep = job.sequence.keep
    metadata: dict[str, Any] = {}
    records = {
        name: entries
        for name, entries in (recording.metadata_records() if keep.records else {}).items()
        if name != _ROSBAG2_RECORD and any(fnmatchcase(name, glob) for glob in keep.records)
    }
    if records:
        metadata[RECORDS_KEY] = [
            {"name": name, "entries": [list(entry) for entry in entries.items()]}
            for name, entries in records.items()
        ]
    custom_data = recording.custom_data() if keep.custom_data else {}
    if custom_data:
        metadata[CUSTOM_DATA_KEY] = [list(entry) for entry in custom_data.items()]
    attachments = tuple(
        attachment
        for attachment in (recording.attachments() if keep.attachments else ())
        if any(fnmatchcase(attachment.name, glob) for glob in keep.attachments)
    )
    return KeptContent(metadata, attachments, tuple(_findings(job, attachments)))


def _findings(job: Job, attachments: tuple[Attachment, ...]) -> Iterator[Finding]:
    """Yield a finding if the destination cannot store the attachments."""
    destination = destination_of(job.destination)
    if attachments and not destination.can_attach:
        size = bytes_text(sum(attachment.size_bytes for attachment in attachments))
        yield Finding(
            "attachments-not-stored",
            Severity.WARNING,
            f"{counted(len(attachments), 'attachment')} ({size}) cannot be stored in {destination.describe()}",
            job.span("sequence", "keep", "attachments") or job.span("target"),
            "ingest into a store as well, or set sequence.keep.attachments: []",
        )


def attach_files(plan: Plan, recording: Recording, session: Session, observe: Observer) -> None:
    """Store the attachments of a plan. A damaged attachment is not stored, but reported as a finding.

    Raises:
        SinkError: An attachment cannot be written.
    """
    if not plan.attachments or not destination_of(plan.destination).can_attach:
        return
    attachable = cast("AttachableSession", session)  # as `can_attach` promises
    for attachment in plan.attachments:
        file = Attached(attachment.name, attachment.media_type, attachment.log_ns, attachment.create_ns)
        try:
            attachable.attach(file, recording.attachment_chunks(attachment))
        except BagError as error:
            message = f"the attachment {attachment.name!r} is not stored: {error.what}"
            observe(Noted(Finding("damaged-record", Severity.WARNING, message, help=DAMAGE_HELP)))
