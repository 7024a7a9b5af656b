"""This file is `ingest inspect`: what a recording holds, and what would become of each topic."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["inspect"]


def inspect(
    path: Annotated[
        str, typer.Argument(metavar="BAG", help="A recording: a file, a rosbag2 directory, or a URL.")
    ],
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="As ros2_humble; for recordings without definitions.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List topics, types, counts, rates, time span, definitions and the adapter each topic would get."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.collector import collect_as_usual
    from mosaico_ingest.cli.tables import print_inspection
    from mosaico_ingest.cli.without_pandas import forgo_pandas

    collect_as_usual()
    forgo_pandas()
    print_inspection(api.inspect_recording(path, ros_distro=ros_distro), as_json=as_json)
