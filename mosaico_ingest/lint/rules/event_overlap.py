"""The check of `event-overlap`: events that overlap."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.events import event_problems
from mosaico_ingest.lint.rule import Check

CHECK = Check("event-overlap", job=partial(event_problems, rule="event-overlap"), reads_files=True)
