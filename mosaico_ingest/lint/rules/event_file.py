"""The check of `event-file`: an event file that cannot be used."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.events import event_problems
from mosaico_ingest.lint.rule import Check

CHECK = Check("event-file", job=partial(event_problems, rule="event-file"), reads_files=True)
