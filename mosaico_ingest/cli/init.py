"""This file is `ingest init`: the draft of a manifest from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["init"]


def init(
    path: Annotated[
        str, typer.Argument(metavar="BAG", help="A recording: a file, a rosbag2 directory, or a URL.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Where to write it.", metavar="JOB.yaml", show_default="print it"),
    ] = None,
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="As ros2_humble; for recordings without definitions.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace a file that is there.")] = False,
) -> None:
    """Draft a manifest: every topic with its type, count and adapter, and what one may want to change."""
    from shlex import quote

    from mosaico_ingest import api
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.plan.draft import draft_manifest
    from mosaico_ingest.remote.path import as_path
    from mosaico_ingest.report.units import counted
    from mosaico_ingest.textfile import write_whole

    if out is not None and out.exists() and not force:
        raise typer.BadParameter(f"{out} is there already; --force replaces it", param_hint="--out")
    found = api.inspect_recording(path, ros_distro=ros_distro)
    if not found.topics:
        raise NothingMatched("the recording has no topic", where=path)
    folder = out.parent if out is not None else Path()
    text = draft_manifest(found, as_path(path), folder=folder, ros_distro=ros_distro)
    taken = len({topic.topic for topic in found.topics if topic.problem is None})
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_whole(out, text)
        then = f"; run it with `ingest {quote(str(out))}`" if taken else ""
        typer.echo(f"{out}: {counted(taken, 'topic')}{then}")
    if not taken:
        first = found.topics[0]
        why = f"{first.topic}: {first.problem}"
        raise NothingMatched("no topic can be ingested as it is", where=path, hint=why)
