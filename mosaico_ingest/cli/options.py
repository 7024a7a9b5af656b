"""Options and arguments that several commands share, and the output files that options name."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from typer.models import OptionInfo

from mosaico_ingest.job import values

DEFAULT_STORE = str(values.DEFAULT_STORE)
DISTROS = ", ".join(each.value for each in values.Stores if each.value.startswith("ros"))
"""The distros with known definitions."""
STANDARD_OUTPUT = Path("-")
"""The path that output options accept for standard output."""
STORE = typer.Option(
    "--store", help="Folder or URL of the store.", metavar="DIR|URL", show_default=DEFAULT_STORE
)


def log_level(default: str | None = None) -> OptionInfo:
    """Return the option `--log`. `default` names its default in the help if the parameter's default is None."""
    return typer.Option(
        "--log",
        "-l",
        help="Log level: DEBUG, INFO, WARNING, ERROR or CRITICAL.",
        metavar="LEVEL",
        show_default=default or True,
    )


ManifestArgument = Annotated[Path, typer.Argument(metavar="JOB.yaml", help="A job manifest.")]
RecordingArgument = Annotated[
    str, typer.Argument(metavar="BAG", help="A .bag, .db3 or .mcap file, a rosbag2 directory, or a URL.")
]
DistroOption = Annotated[
    str | None,
    typer.Option(
        "--ros-distro",
        help=f"Distro of recordings without definitions: {DISTROS}.",
        metavar="DISTRO",
    ),
]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topics",
        "-t",
        help="Topic name or glob, such as /cam/*; !GLOB excludes. Repeatable.",
        metavar="GLOB",
    ),
]
StoreOption = Annotated[str, STORE]
ApiKeyOption = Annotated[
    str | None,
    typer.Option(
        "--api-key",
        envvar="MOSAICO_API_KEY",
        metavar="KEY",
        help="API key for the server.",
        show_envvar=True,
    ),
]
TlsCertOption = Annotated[
    Path | None,
    typer.Option("--tls-cert", metavar="FILE", help="CA certificate of the server, in PEM format."),
]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Replace an existing file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
LogOption = Annotated[str | None, log_level("run.log_level")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
VerifyOption = Annotated[
    bool,
    typer.Option(
        "--verify",
        help="Open stored recordings and compare their content, even if their files have not changed.",
    ),
]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FILE",
        help="Write the report as JSON, or as JSON Lines during the run (FILE.jsonl); - writes JSON to stdout.",
    ),
]

JunitOption = Annotated[
    Path | None,
    typer.Option(
        "--junit",
        metavar="FILE",
        help="Write a test case per expectation and finding as JUnit XML; - writes to stdout.",
    ),
]
SarifOption = Annotated[
    Path | None,
    typer.Option(
        "--sarif", metavar="FILE", help="Write failed expectations and findings as SARIF; - writes to stdout."
    ),
]


@contextmanager
def output_file(path: Path) -> Generator[Callable[[str], object]]:
    """Yield the function that appends text to the file of an output option, or to standard output if the path is `-`.

    The file replaces an existing one when the block ends without an error.

    Raises:
        SinkError: The file cannot be written.
    """
    if path == STANDARD_OUTPUT:
        yield sys.stdout.write
        return
    from mosaico_ingest.documents import AtomicFile

    with AtomicFile(path) as file:
        yield file.write


def write_output(path: Path, text: str | Iterable[str], *, announce: bool = False) -> None:
    """Write the text of an output option: to a file, or to standard output if the path is `-`.

    With `announce`, print the name of the file to standard error.

    Raises:
        SinkError: The file cannot be written.
    """
    with output_file(path) as write:
        for part in [text] if isinstance(text, str) else text:
            write(part)
    if announce and path != STANDARD_OUTPUT:
        from mosaico_ingest.cli.console import print_line

        print_line(f"wrote {path}", stderr=True)
