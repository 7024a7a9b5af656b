"""`ingest quickstart`, `init`, `expand` and `schema`, and the suggestions of `ingest` without arguments."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mosaico_ingest.cli.console import print_json, print_line
from mosaico_ingest.cli.options import (
    STANDARD_OUTPUT,
    DistroOption,
    ForceOption,
    JsonOption,
    JunitOption,
    ManifestArgument,
    SarifOption,
    write_output,
)
from mosaico_ingest.display import counted
from mosaico_ingest.errors import IngestError, ManifestError

if TYPE_CHECKING:
    from mosaico_ingest.job.reference import Expanded

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = (_PACKAGE / "quickstart", _PACKAGE.parent / "configs")
"""The folder of the files in an installed wheel, and in a checkout."""
_MANIFEST = re.compile(r"^bag:", re.MULTILINE)
_MAX_ENTRIES = 1000
"""Number of entries of a folder that suggestions consider."""
_MANIFEST_BYTES = 1 << 16
"""Number of bytes of a YAML file in which suggestions look for the section `bag`."""
schema_app = typer.Typer()
WriteOption = Annotated[
    Path | None,
    typer.Option("--write", metavar="DIR", help="Write NAME.schema.json into DIR, for editors."),
]
CheckOption = Annotated[
    Path | None,
    typer.Option("--check", metavar="DIR", help="Fail if a schema in DIR is not up to date."),
]


def quickstart(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder to write, which must not exist.")
    ] = Path("quickstart"),
) -> None:
    """Write a small recording with its manifest, adapter and message definitions into a folder."""
    source = next(each for each in _FOLDERS if (each / "quickstart.yaml").is_file())
    if folder.exists():
        raise ManifestError("the folder exists", where=str(folder), hint="name another folder, or remove it")
    shutil.copytree(
        source / "quickstart", folder / "quickstart", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(source / "quickstart.yaml", folder)
    print_line(f"wrote {folder}; ingest it with: ingest {shlex.quote(str(folder / 'quickstart.yaml'))}")


def init(
    recordings: Annotated[
        list[str],
        typer.Argument(
            metavar="BAG...",
            help="A .bag, .db3 or .mcap file, a rosbag2 directory, or a URL; with --expect also several.",
        ),
    ],
    *,
    expect: Annotated[
        bool,
        typer.Option(
            "--expect", help="Draft the section `expect` instead, which all of the recordings fulfill."
        ),
    ] = False,
    tolerance: Annotated[
        float,
        typer.Option(
            "--tolerance",
            min=0,
            max=1000,
            metavar="PERCENT",
            help="With --expect: how far to widen the range of the recordings' values.",
        ),
    ] = 20,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Write to this file.", metavar="FILE.yaml", show_default="stdout"),
    ] = None,
    ros_distro: DistroOption = None,
    force: ForceOption = False,
) -> None:
    """Draft a manifest for a recording: every topic with its type, count and adapter, and common options.

    With --expect, draft a data contract from good recordings.
    """
    if out is not None and out != STANDARD_OUTPUT and out.exists() and not force:
        raise typer.BadParameter(f"{out} exists; replace it with --force", param_hint="--out")
    if expect:
        _draft_contract(recordings, tolerance=tolerance, out=out, ros_distro=ros_distro)
        return
    if len(recordings) > 1:
        raise typer.BadParameter("several recordings need --expect", param_hint="BAG")
    _draft_manifest(recordings[0], out=out, ros_distro=ros_distro)


def expand(manifest: ManifestArgument, as_json: JsonOption = False) -> None:
    """Print every job of a manifest as a separate manifest, without `extends`, `matrix` and secrets.

    Environment variables are not replaced. A comment shows the location of a value from another file.
    """
    from mosaico_ingest.job.reference import expand_manifest, to_yaml

    jobs = expand_manifest(manifest)
    if as_json:
        print_json([job.value for job in jobs])
        return
    documents = (f"{_cell_comment(manifest, job)}{to_yaml(job.value, job.remark)}" for job in jobs)
    typer.echo("---\n".join(documents), nl=False)


def suggestions(folder: Path) -> list[str]:
    """Return the lines that suggest commands for the content of a folder; none if it has nothing to ingest."""
    entries = sorted(islice((path for path in folder.iterdir() if path.name[0] != "."), _MAX_ENTRIES))
    manifests = [path.name for path in entries if _is_manifest(path)]
    recordings = list(_recordings(entries))
    lines: list[str] = []
    if manifests:
        job = shlex.quote(manifests[0])
        lines += [
            f"{_count(manifests, 'job manifest')}:",
            f"  ingest plan {job}",
            f"  ingest {job}",
        ]
    if recordings:
        bag = shlex.quote(recordings[0])
        lines += [
            f"{_count(recordings, 'recording')}:",
            f"  ingest inspect {bag}",
            f"  ingest bag {bag}",
            f"  ingest init {bag}",
        ]
    if (folder / "mosaico" / "catalog.sqlite").is_file():
        lines += ["a store with ingested sequences, mosaico:", "  ingest store ls", "  ingest browse"]
    return lines


class Document(str, Enum):
    """Files that have a JSON Schema."""

    JOB = "job"
    ADAPTER = "adapter"
    PLAN = "plan"
    REPORT = "report"
    LOCK = "lock"


@schema_app.callback(invoke_without_command=True)
def schema(context: typer.Context, write: WriteOption = None, check: CheckOption = None) -> None:
    """Print, write or check the JSON Schemas (draft 2020-12) of files, or lock message definitions.

    Without a command, --write and --check apply to all schemas.
    """
    if context.invoked_subcommand is None:
        if write is None and check is None:
            choices = ", ".join(choice.value for choice in Document)
            raise typer.BadParameter(f"give one of {choices}", param_hint="COMMAND")
        write_schemas(list(Document), write, check)


@schema_app.command()
def job(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of job manifests."""
    write_schemas([Document.JOB], write, check)


@schema_app.command()
def adapter(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of adapter files."""
    write_schemas([Document.ADAPTER], write, check)


@schema_app.command()
def plan(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of plan files."""
    write_schemas([Document.PLAN], write, check)


@schema_app.command()
def report(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of report files."""
    write_schemas([Document.REPORT], write, check)


@schema_app.command()
def lock(
    manifest: Annotated[
        Path | None, typer.Argument(metavar="JOB.yaml", help="A job manifest.", show_default=False)
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compare the recordings with the lock file; write nothing.")
    ] = False,
    junit: JunitOption = None,
    sarif: SarifOption = None,
) -> None:
    """Write the types, fields and output columns of every selected topic to JOB.lock.json.

    With `definitions: locked` in the manifest, plans and runs refuse recordings that differ from this file. Without a
    manifest, print the JSON Schema of lock files. Exit codes of --check: 0 equal, 6 different. --junit and --sarif write
    the result of --check.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas

    ci_options = [name for name, value in (("--junit", junit), ("--sarif", sarif)) if value is not None]
    if manifest is None and (check or ci_options):
        raise typer.BadParameter("give a manifest", param_hint="JOB.yaml")
    if ci_options and not check:
        raise typer.BadParameter("add --check", param_hint=", ".join(ci_options))
    if manifest is None:
        write_schemas([Document.LOCK], None, None)
        return
    from mosaico_ingest.services.schemas import check_locked, write_lock

    collect_garbage_as_usual()
    jobs = api.compile_job(manifest, locked=False)
    hide_pandas(jobs)
    if check:
        with _ci_files(manifest, junit, sarif):
            count = check_locked(manifest, jobs)
        print_line(f"{counted(count, 'recording')}: no differences", style="green")
        return
    result = write_lock(manifest, jobs)
    for difference in result.differences:
        print_line(str(difference))
    topics = counted(len(result.lock.topics), "topic")
    state = "" if result.is_new else f", {counted(len(result.differences), 'difference')}"
    print_line(f"{result.path}: {topics}{state}", style="bold")


def write_schemas(documents: Sequence[Document], write: Path | None, check: Path | None) -> None:
    """Print the schemas, write them into the folder `write`, or compare them with those in the folder `check`.

    Raises:
        typer.Exit: A schema is not up to date.
    """
    from mosaico_ingest.documents import write_atomically

    stale = 0
    for each in documents:
        text = _schema_text(each)
        if write is not None:
            write_atomically(_schema_file(write, each), text)
        elif check is not None:
            stale += _is_stale(_schema_file(check, each), text)
        else:
            typer.echo(text, nl=False)
    if stale:
        raise typer.Exit(1)


def _cell_comment(manifest: Path, job: Expanded) -> str:
    cell = ", ".join(f"{name}={value}" for name, value in job.cell.items())
    return f"# {manifest}: {cell}\n" if cell else ""


def _draft_contract(
    recordings: Sequence[str], *, tolerance: float, out: Path | None, ros_distro: str | None
) -> None:
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.remote import as_path
    from mosaico_ingest.services.draft_contract import draft_contract, measure_recording

    collect_garbage_as_usual()
    hide_pandas()
    measured = [measure_recording(as_path(path), ros_distro=ros_distro) for path in recordings]
    write_output(out or STANDARD_OUTPUT, draft_contract(measured, tolerance=tolerance))
    if out is not None and out != STANDARD_OUTPUT:
        topics = len({topic for one in measured for topic in one.topics})
        print_line(
            f"{out}: expectations of {counted(topics, 'topic')}, from {counted(len(measured), 'recording')}"
        )


def _draft_manifest(path: str, *, out: Path | None, ros_distro: str | None) -> None:
    from shlex import quote

    from mosaico_ingest import api
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.remote import as_path
    from mosaico_ingest.services.draft import draft_manifest

    inspection = api.inspect_recording(path, ros_distro=ros_distro)
    if not inspection.topics:
        raise NothingMatched("the recording has no topics", where=path)
    folder = out.parent if out is not None else Path()
    text = draft_manifest(inspection, as_path(path), folder=folder, ros_distro=ros_distro)
    count = len({topic.topic for topic in inspection.topics if topic.problem is None})
    write_output(out or STANDARD_OUTPUT, text)
    if out is not None and out != STANDARD_OUTPUT:
        command = f"; run it with `ingest {quote(str(out))}`" if count else ""
        print_line(f"{out}: {counted(count, 'topic')}{command}")
    if not count:
        topic = inspection.topics[0]
        raise NothingMatched(
            "no topic can be ingested without changes", where=path, hint=f"{topic.topic}: {topic.problem}"
        )


def _count(names: list[str], noun: str) -> str:
    return f"1 {noun}, {names[0]}" if len(names) == 1 else f"{len(names)} {noun}s, such as {names[0]}"


def _is_manifest(path: Path) -> bool:
    if path.suffix not in {".yaml", ".yml"} or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return bool(_MANIFEST.search(file.read(_MANIFEST_BYTES).decode("utf-8", "replace")))
    except OSError:
        return False


def _recordings(entries: list[Path]) -> Iterator[str]:
    from mosaico_ingest.containers import RECORDING_NAME

    for path in entries:
        is_file = path.is_file() and RECORDING_NAME.search(path.name)
        if is_file or (path.is_dir() and (path / "metadata.yaml").is_file()):
            yield path.name


@contextmanager
def _ci_files(manifest: Path, junit: Path | None, sarif: Path | None) -> Generator[None]:
    """Write the outcome of a check of the lock file as JUnit XML and SARIF, even if the check raises."""
    error: IngestError | None = None
    try:
        yield
    except IngestError as caught:
        error = caught
        raise
    finally:
        if junit is not None or sarif is not None:
            from mosaico_ingest.cli.check import CheckedRecording, CiFiles

            text, findings = (None, ()) if error is None else (str(error), error.findings)
            with CiFiles(junit, sarif) as files:
                files.add(CheckedRecording(f"schema lock {manifest}", error=text, findings=findings))


def _schema_text(document: Document) -> str:
    from mosaico_ingest.documents import document_schema
    from mosaico_ingest.pipeline.definition_changes import LockDocument
    from mosaico_ingest.pipeline.plan_document import PlanDocument
    from mosaico_ingest.report.run import report_schema
    from mosaico_ingest.services.schemas import adapter_editor_schema, job_editor_schema

    schemas: dict[Document, Callable[[], dict[str, Any]]] = {
        Document.JOB: job_editor_schema,
        Document.ADAPTER: adapter_editor_schema,
        Document.PLAN: partial(document_schema, PlanDocument),
        Document.REPORT: report_schema,
        Document.LOCK: partial(document_schema, LockDocument),
    }
    return json.dumps(schemas[document](), indent=2, ensure_ascii=False) + "\n"


def _schema_file(folder: Path, document: Document) -> Path:
    return folder / f"{document.value}.schema.json"


def _is_stale(path: Path, text: str) -> bool:
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return False
    typer.echo(f"{path} is not up to date — run `ingest schema --write {path.parent}`", err=True)
    return True
