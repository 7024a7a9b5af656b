"""The check of `event-overlap`: events that overlap."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.check import Check, event_problems

CHECK = Check("event-overlap", job=partial(event_problems, rule="event-overlap"), reads_files=True)
