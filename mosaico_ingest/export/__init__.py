"""A stored sequence written back as a recording: topics of the store in, one file and an account of it out.

Whether messages are what was stored is tried on every batch; what is lost or left out is in the account.
"""

from __future__ import annotations

from mosaico_ingest.export.export import ExportReport, TopicExport, export_sequence

__all__ = ["ExportReport", "TopicExport", "export_sequence"]
