"""This file says what took the time: the steps of all recordings together, and the recordings that took longest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mosaico_ingest.report.model import Report, Steps

__all__ = ["STEP_WORDS", "longest_step", "slowest", "step_seconds", "total_seconds"]

STEP_WORDS = {
    "prepare": "opening and planning",
    "read": "reading",
    "decode": "decoding",
    "adapt": "adapting",
    "wait": "waiting for the writer",
    "commit": "committing",
}
"""The steps that follow one another; the writer works beside them."""


def step_seconds(steps: Steps) -> dict[str, float]:
    """Return the seconds of each step that others wait for."""
    return {name: float(getattr(steps, name)) for name in STEP_WORDS}


def total_seconds(recordings: Sequence[Report]) -> Mapping[str, float]:
    """Return the seconds of each step, of all recordings; empty where none says."""
    timed = [step_seconds(one.steps) for one in recordings]
    sums = {name: sum(one[name] for one in timed) for name in STEP_WORDS}
    return sums if any(sums.values()) else {}


def longest_step(steps: Steps) -> str:
    """Return the step a recording spent most of its time on, and its share, as `reading, 62%`."""
    seconds = step_seconds(steps)
    name = max(seconds, key=lambda step: seconds[step])
    total = sum(seconds.values())
    return f"{STEP_WORDS[name]}, {seconds[name] / total:.0%}" if total else ""


def slowest(recordings: Sequence[Report], most: int) -> list[tuple[int, Report]]:
    """Return the recordings that took longest, with their positions; of those whose steps are known."""
    timed = [(at, one) for at, one in enumerate(recordings) if any(step_seconds(one.steps).values())]
    return sorted(timed, key=lambda found: -found[1].duration_s)[:most]
