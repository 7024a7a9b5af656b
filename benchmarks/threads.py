"""CPU time of each kind of thread in a run, which does not depend on the load of the machine.

    python benchmarks/threads.py RECORDING...

A run takes at least as long as its busiest thread. The environment variable `OMP_NUM_THREADS` sets the number of cores
that the run assumes.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

from mosaico_ingest import RosbagInjector, ROSInjectionConfig

KINDS = {"mosaico-read": "read", "group": "write", "mosaico-ingest-write": "write", "segment": "write"}
"""The step that threads work on, by the start of their name; other threads hash the recording."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    arguments = parser.parse_args()
    print("| recording | main thread | read | write | other | total |\n|---|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        # The first run imports everything, so that the others show only the time of their recordings.
        ingest(arguments.recordings[0], Path(folder, "first"))
        for number, recording in enumerate(arguments.recordings):
            seconds = ingest(recording, Path(folder, str(number)))
            columns = (seconds[kind] for kind in ("main", "read", "write", "other"))
            cells = " | ".join(f"{value:.2f} s" for value in (*columns, seconds.total()))
            print(f"| {recording.stem} | {cells} |", flush=True)


def ingest(recording: Path, store: Path) -> Counter[str]:
    """Ingest a recording, and return the seconds of CPU time by kind of thread."""
    seconds: Counter[str] = Counter()
    run = threading.Thread.run

    def timed(thread: threading.Thread) -> None:
        try:
            run(thread)
        finally:
            kind = next((kind for start, kind in KINDS.items() if thread.name.startswith(start)), "other")
            seconds[kind] += time.thread_time()

    threading.Thread.run = timed
    try:
        start = time.thread_time()
        RosbagInjector(ROSInjectionConfig(recording, "run", store=store)).run()
        seconds["main"] = time.thread_time() - start
    finally:
        threading.Thread.run = run
    return seconds


if __name__ == "__main__":
    main()
