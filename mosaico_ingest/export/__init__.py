"""Export of a sequence of a store or a server to a recording, with a report of its fidelity.

The export adapts every restored batch of messages again and compares it with the stored rows. The report lists each difference and
each excluded topic. The package must not depend on the pipeline.
"""

from __future__ import annotations

from mosaico_ingest.export.export import ExportReport, TopicExport, export_sequence
from mosaico_ingest.export.sources import ServerSequence, StoreSequence

__all__ = ["ExportReport", "ServerSequence", "StoreSequence", "TopicExport", "export_sequence"]
