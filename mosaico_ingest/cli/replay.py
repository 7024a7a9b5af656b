"""This file is `ingest replay`: what lies in a quarantine, once the manifest is mended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["replay"]

_DONE = {0, 4}
"""Exit codes of runs that took what could be taken."""


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
    log: Annotated[
        str | None, typer.Option("--log", help="Log level; overrides run.log_level.", metavar="LEVEL")
    ] = None,
) -> None:
    """Add quarantined messages to the sequences they belong to; what fails again stays in the quarantine."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.session import run_configs
    from mosaico_ingest.executors.replay import replay_config
    from mosaico_ingest.quarantine.kept import find_kept
    from mosaico_ingest.report.model import RunReport

    found = find_kept(folder)
    configs = api.compile_job(manifest)
    jobs = [replay_config(kept, configs) for kept in found]

    def mark(result: RunReport) -> None:
        for kept, recording in zip(found, result.recordings, strict=False):
            if recording.exit_code in _DONE:
                kept.mark_replayed()

    run_configs(jobs, report=report, quiet=quiet, log=log, jobs=1, finished=mark)
