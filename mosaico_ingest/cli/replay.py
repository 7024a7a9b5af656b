"""This file is `ingest replay`: what lies in a quarantine, once the manifest is mended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.cli.log_format import LogOption

__all__ = ["replay"]

_DONE = {0, 4}
"""Exit codes of runs that took what could be taken."""
_SAYS = {
    "STORED": "its messages are in the sequence already",
    "FORGOTTEN": "the run that kept it is not part of its sequence; ingest the recording for what it holds",
}


def replay(
    folder: Annotated[
        Path, typer.Argument(metavar="QUARANTINE", help="The folder rejected messages lie in.")
    ],
    manifest: Annotated[
        Path, typer.Option("--manifest", "-m", help="The mended manifest of the job.", metavar="JOB.yaml")
    ],
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the report of this call as JSON.", metavar="FILE")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: LogOption = None,
) -> None:
    """Add quarantined messages to the sequences they belong to; what fails again stays in the quarantine."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.cli.session import run_configs
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.executors.replay import Whereabouts, alone, replays
    from mosaico_ingest.report.model import RunReport

    def mark(result: RunReport) -> None:
        for replay, recording in zip(waiting, result.recordings, strict=False):
            if recording.exit_code in _DONE:
                replay.kept.mark_replayed()

    configs = api.compile_job(manifest)
    with alone(folder):
        found = replays(folder, configs)
        for replay in found:
            if replay.whereabouts is Whereabouts.STORED:
                replay.kept.mark_replayed()
            if replay.whereabouts is not Whereabouts.WAITING and not quiet:
                print_line(f"{replay.kept.messages.name}: {_SAYS[replay.whereabouts.name]}", stderr=True)
        waiting = [replay for replay in found if replay.whereabouts is Whereabouts.WAITING]
        if all(replay.whereabouts is Whereabouts.FORGOTTEN for replay in found):
            raise NothingMatched("there is nothing to replay", where=str(folder), hint=_SAYS["FORGOTTEN"])
        run_configs(
            [replay.config for replay in waiting], report=report, quiet=quiet, log=log, jobs=1, finished=mark
        )
