"""This file is `ingest bag`: one recording without a manifest, through the same configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.policies import IfExists

__all__ = ["bag"]


def bag(
    path: Annotated[
        str, typer.Argument(metavar="BAG", help="A .bag, .db3 or .mcap file, a rosbag2 directory, or a URL.")
    ],
    *,
    name: Annotated[str, typer.Option("--name", "-n", help="Name of the sequence.")],
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", "-t", help="Topic pattern, as /cam/*; !/cam/debug* takes away. Repeatable."),
    ] = None,
    more_topics: Annotated[
        list[str] | None, typer.Argument(metavar="TOPIC", help="More patterns, after --topics.")
    ] = None,
    metadata: Annotated[
        str | None,
        typer.Option("--metadata", help="A JSON object, or the file that holds one.", metavar="JSON|FILE"),
    ] = None,
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="As ros2_humble; for recordings without definitions.")
    ] = None,
    host: Annotated[str | None, typer.Option("--host", help="A Mosaico server instead of the store.")] = None,
    port: Annotated[int, typer.Option("--port", help="The server's port.")] = 6726,
    api_key: Annotated[
        str | None,
        typer.Option("--api-key", envvar="MOSAICO_API_KEY", help="Its API key.", show_envvar=True),
    ] = None,
    tls_cert: Annotated[
        Path | None,
        typer.Option("--tls-cert", metavar="FILE", help="CA certificate the server is checked against, PEM."),
    ] = None,
    store: Annotated[
        str | None,
        typer.Option("--store", help="The store to write to.", metavar="DIR|URL", show_default="mosaico"),
    ] = None,
    if_exists: Annotated[
        IfExists,
        typer.Option("--if-exists", help="Where the sequence is there; skip needs the same content."),
    ] = IfExists.FAIL,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE", help="Write the report as JSON.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: Annotated[
        str | None,
        typer.Option(
            "--log",
            "-l",
            help="DEBUG, INFO, WARNING, ERROR or CRITICAL.",
            metavar="LEVEL",
            show_default="INFO",
        ),
    ] = None,
) -> None:
    """Ingest one recording, without a manifest."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.session import run_configs
    from mosaico_ingest.cli.without_pandas import forgo_pandas

    config = api.quick_config(
        path,
        sequence_name=name,
        topics=[*(topics or ()), *(more_topics or ())],
        metadata=metadata,
        ros_distro=ros_distro,
        host=host,
        port=port,
        api_key=api_key,
        tls_cert_path=tls_cert,
        store=store,
        if_exists=if_exists,
    )
    forgo_pandas([config])
    run_configs([config], report=report, quiet=quiet, log=log)
