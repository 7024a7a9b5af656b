"""The check of `event-interval`: an event whose end is not later than its start."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.events import event_problems
from mosaico_ingest.lint.rule import Check

CHECK = Check("event-interval", job=partial(event_problems, rule="event-interval"), reads_files=True)
