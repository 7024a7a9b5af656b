"""`ingest watch` and `status`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:  # imported for real when the command runs, so that --help starts fast
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.report.model import Report
    from mosaico_ingest.services.watch import Arrivals

__all__ = [
    "status",
    "watch",
]

STYLES = {"done": "green", "new": "cyan", "changed": "yellow", "failed": "red", "unreadable": "red"}


def status(
    manifests: Annotated[list[Path], typer.Argument(metavar="JOB.yaml", help="Job manifests.")],
    *,
    check: Annotated[bool, typer.Option("--check", help="Exit 1 unless every recording is done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say of every recording whether its sequence is there, whole and of the same content; writes nothing."""
    import json
    from collections import Counter

    from msgspec import to_builtins
    from rich.text import Text

    from mosaico_ingest import api
    from mosaico_ingest.cli.console import plain_table
    from mosaico_ingest.cli.report import open_console, print_json

    found = [one for manifest in manifests for one in api.job_status(manifest)]
    if as_json:
        print_json(json.dumps([to_builtins(one) for one in found], indent=2))
    else:
        table = plain_table("sequence", "status", "recording")
        for one in found:
            style = STYLES[one.standing.value]
            files = ", ".join(one.files)
            known = one.why.startswith(files)  # an error says where it is from
            said = one.why if known else f"{files}: {one.why}" if one.why else files
            table.add_row(one.sequence, Text(one.standing.value, style=style), Text(said))
        console = open_console()
        console.print(table)
        counts = Counter(one.standing.value for one in found)
        console.print(", ".join(f"{count} {name}" for name, count in counts.items()), soft_wrap=True)
    if check and any(one.standing.value != "done" for one in found):
        raise typer.Exit(1)


Again = Callable[[Path], str]
"""Gives a recording that failed another turn, and says when that is."""


def watch(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where recordings arrive.", exists=True, file_okay=False)
    ],
    manifest: Annotated[
        Path, typer.Argument(metavar="JOB.yaml", help="What is done with each; its bag.path is not used.")
    ],
    *,
    rest: Annotated[
        float, typer.Option("--rest", min=0.0, help="Seconds without a change after which a file is whole.")
    ] = 10.0,
    every: Annotated[float, typer.Option("--every", min=0.05, help="Seconds between two looks.")] = 2.0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Recordings ingested at a time.")] = 1,
    once: Annotated[
        bool,
        typer.Option(
            "--once", help="Ingest what is there and comes to rest, then leave with the exit code of a run."
        ),
    ] = False,
    log: Annotated[
        str, typer.Option("--log", "-l", help="DEBUG, INFO, WARNING, ERROR or CRITICAL.", metavar="LEVEL")
    ] = "WARNING",
) -> None:
    """Ingest what arrives in a folder, until it is interrupted; what is in the destination already is left alone."""
    import time
    from functools import partial

    from mosaico_ingest.cli.logs import set_up_logging
    from mosaico_ingest.cli.process import collect_as_usual, interrupt_on_terminate
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.report.model import gravest
    from mosaico_ingest.services.watch import Arrivals

    set_up_logging(log)
    interrupt_on_terminate()
    collect_as_usual()
    arrivals = Arrivals(folder, rest)
    load_manifests(manifest)  # a mistake is said now, not with the first recording
    _say(f"watching {folder}")
    again = _never if once else partial(_again, arrivals)
    codes: list[int] = []
    leave_at = time.monotonic() + rest + every if once else float("inf")
    try:
        while True:
            settled = arrivals.settled(time.monotonic())
            if settled and not _ingest(manifest, settled, jobs, again, codes):
                break
            if not settled and time.monotonic() > leave_at:
                break
            time.sleep(every)
    except KeyboardInterrupt:
        pass
    _say("stopped watching")
    code = gravest(codes) if once else 0
    if code:
        raise typer.Exit(code)


def _ingest(manifest: Path, settled: tuple[Path, ...], jobs: int, again: Again, codes: list[int]) -> bool:
    """Ingest recordings, say a line about each and note its exit code; return whether to go on."""
    from mosaico_ingest.executors.processes import Processes
    from mosaico_ingest.report.events import RunStatus, ignore_batch

    work = [(path, config) for path in settled for config in _configs(manifest, path, again, codes)]
    # Even one recording goes to a process of its own: what kills it does not end the watch.
    reports = Processes(jobs).map([config for _, config in work], ignore_batch)
    going_on = True
    for (path, _), report in zip(work, reports, strict=False):
        going_on = going_on and report.status is not RunStatus.INTERRUPTED
        codes.append(report.exit_code)
        failed = report.exit_code not in {0, 4}
        _say(f"{path}: {_outcome(report)}{again(path) if failed and going_on else ''}")
    return going_on


def _configs(manifest: Path, path: Path, again: Again, codes: list[int]) -> tuple[ROSInjectionConfig, ...]:
    from mosaico_ingest import api
    from mosaico_ingest.errors import IngestError

    try:
        return api.compile_recording(manifest, path)
    except IngestError as error:
        codes.append(error.exit_code)
        _say(f"{path}: failed: {error}{again(path)}")
        return ()


def _outcome(report: Report) -> str:
    from mosaico_ingest.report.units import count_text, seconds_text

    done = f"{report.status.value} as {report.sequence}"
    if report.error is not None:
        return f"{done}: {report.error}"
    totals = report.totals
    rejected = f", {count_text(totals.rejected)} rejected" if totals.rejected else ""
    return f"{done}, {count_text(totals.written)} messages{rejected}, {seconds_text(report.duration_s)}"


def _again(arrivals: Arrivals, path: Path) -> str:
    import time

    return f"; tried again in {arrivals.again(path, time.monotonic()):.0f} s"


def _never(_path: Path) -> str:
    return ""


def _say(line: str) -> None:
    from datetime import datetime, timezone

    from mosaico_ingest.cli.console import print_line

    print_line(f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ} {line}")
