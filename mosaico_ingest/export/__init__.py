"""Exports: a sequence of the store in, one recording and a report of its fidelity out.

Every batch of messages is adapted again and compared with the stored rows; the report lists each difference and each
excluded topic. The package must not depend on the pipeline.
"""

from __future__ import annotations

from mosaico_ingest.export.export import ExportReport, TopicExport, export_sequence

__all__ = ["ExportReport", "TopicExport", "export_sequence"]
