"""Measurement of a complete process: time, CPU time and peak memory as the operating system reports them."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median


@dataclass(frozen=True)
class Sample:
    """The figures and the output of one run of a program."""

    wall_s: float
    cpu_s: float
    peak_bytes: int
    output: str


def run(command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> Sample:
    """Run a program to its end and measure it.

    Raises:
        SystemExit: The program failed.
    """
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile("w+") as output:
        start = time.perf_counter()
        child = subprocess.Popen(
            list(map(str, command)),
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**clean, **(environment or {})},
        )
        _, status, used = os.wait4(child.pid, 0)
        wall_s = time.perf_counter() - start
        child.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    if child.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed ({child.returncode}):\n{text}")
    return Sample(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss << 10, text)


def typical(samples: Sequence[Sample]) -> Sample:
    """Return the median of each figure."""
    return Sample(
        median(one.wall_s for one in samples),
        median(one.cpu_s for one in samples),
        int(median(one.peak_bytes for one in samples)),
        samples[-1].output,
    )
