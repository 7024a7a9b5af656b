"""The check of `event-interval`: an event whose end is not later than its start."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.check import Check, event_problems

CHECK = Check("event-interval", job=partial(event_problems, rule="event-interval"), reads_files=True)
