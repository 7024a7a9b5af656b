"""Recordings written: definitions, times and payloads in; one file out, which is there when it is whole."""

from __future__ import annotations

from mosaico_ingest.bag.writing.opening import open_writer
from mosaico_ingest.bag.writing.writer import RecordingWriter

__all__ = ["RecordingWriter", "open_writer"]
