"""The check of `event-file`: an event file that cannot be used."""

from __future__ import annotations

from functools import partial

from mosaico_ingest.lint.check import Check, event_problems

CHECK = Check("event-file", job=partial(event_problems, rule="event-file"), reads_files=True)
