"""`ingest plan`, `diff`, `expand` and `init`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from os.path import normpath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal, print_json, print_line
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
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import Severity, join_names
from mosaico_ingest.remote import is_url
from mosaico_ingest.report.units import bytes_text, counted, seconds_text, time_text

if TYPE_CHECKING:
    from mosaico_ingest.job.reference import Expanded
    from mosaico_ingest.pipeline.plan_document import (
        DestinationState,
        Difference,
        Note,
        PlanDocument,
        RecordingPlan,
        Sample,
    )

NOTE_STYLES = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.INFO: "dim"}


def plan(
    manifest: ManifestArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Write the plan as JSON, for `run --plan`; - writes it to stdout.", metavar="FILE"
        ),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Fail if the plan differs from this plan file.", metavar="FILE"),
    ] = None,
    connect: Annotated[
        bool, typer.Option("--connect", help="Connect to the server, if the destination is one.")
    ] = False,
    junit: JunitOption = None,
    sarif: SarifOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make every decision about the real recordings and try a few messages of each topic. Read-only.

    Exit codes: 0 the job can run, 1 it cannot run or differs from --check, 3 no message is selected,
    4 messages would be rejected, 6 a contract is violated.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas

    collect_garbage_as_usual()
    try:
        jobs = api.compile_job(manifest)
        hide_pandas(jobs)
        document = api.plan_job(manifest, jobs=jobs, folder=out.parent if out else None, connect=connect)
    except IngestError as error:
        _write_ci_files([], junit=junit, sarif=sarif, manifest=manifest, error=error)
        raise
    _write_ci_files(document.recordings, junit=junit, sarif=sarif, manifest=manifest)
    if out is not None:
        write_output(out, document.model_dump_json(indent=2) + "\n")
    if out == STANDARD_OUTPUT:
        pass  # the tables would mix with the JSON
    elif as_json:
        typer.echo(document.model_dump_json(indent=2))
    elif check is None:
        print_plan(document, folder=manifest.parent)
    code = document.exit_code
    if check is not None:
        differences = api.plan_differences(check, document)
        if not as_json and out != STANDARD_OUTPUT:
            print_differences(differences)
        code = 1 if differences else 0
    if code:
        raise typer.Exit(code)


def _write_ci_files(
    recordings: Sequence[RecordingPlan],
    *,
    junit: Path | None,
    sarif: Path | None,
    manifest: Path,
    error: IngestError | None = None,
) -> None:
    """Write the files of `--junit` and `--sarif`: an outcome for each planned recording, or the error of the plan."""
    if junit is not None or sarif is not None:
        from mosaico_ingest.cli.ci import CheckedRecording, plan_outcomes, write_ci_files

        outcomes = plan_outcomes(recordings)
        if error is not None:
            outcomes.append(CheckedRecording(str(manifest), None, str(error), error.findings))
        write_ci_files(outcomes, junit=junit, sarif=sarif)


def print_plan(document: PlanDocument, *, folder: Path) -> None:
    """Print the plan of every recording, with paths relative to `folder`, the manifest's folder."""
    for recording in document.recordings:
        _print_recording(recording, folder)
    if len(document.recordings) > 1:
        size = sum(
            file["size_bytes"] for recording in document.recordings for file in recording.plan["files"]
        )
        print_line(f"{counted(len(document.recordings), 'recording')}, {bytes_text(size)}", style="bold")


def _print_recording(recording: RecordingPlan, folder: Path) -> None:
    plan = recording.plan
    destination = plan["destination"]
    if recording.destination.kind == "store":
        destination = _relative(folder, destination)
    print_line(f"{plan['sequence']['name']} → {destination}", style="bold")
    print_line(_source_text(plan, folder))
    samples = {sample.target: sample for sample in recording.samples}
    names = ("topic", "type", "messages", "becomes", "adapter", "because", "sample")
    table = PlainTable(*names, numbers={"messages"})
    for topic in sorted(plan["topics"], key=lambda topic: str(topic["topic"])):
        renamed = "" if topic["target"] == topic["topic"] else f" → {topic['target']}"
        every = "" if topic["every"] == 1 else f" / {topic['every']}"
        count = f"{recording.count_texts[topic['target']]}{every}"
        table.add_row(
            f"{topic['topic']}{renamed}",
            topic["msgtype"],
            count,
            topic["ontology"]["tag"],
            topic["adapter"]["name"],
            str(topic["why"]).replace(f" for {topic['msgtype']}", ""),
            _sample_text(samples[topic["target"]]),
        )
    Terminal().print(table)
    for sample in recording.samples:
        for rejection in sample.rejections:
            rejected = f"{rejection.count} of {sample.read} would be rejected"
            print_line(f"{sample.target}: {rejected} [{rejection.rule}]: {rejection.reason}", style="red")
    _print_notes(recording.notes)
    if recording.is_empty:
        print_line("the selected topics have no message", style="red")
    _print_destination(recording.destination, plan["sequence"], destination)


def _source_text(plan: Mapping[str, Any], folder: Path) -> str:
    size = sum(file["size_bytes"] for file in plan["files"])
    names = ", ".join(_relative(folder, file["path"]) for file in plan["files"])
    text = f"{names}: {plan['container']}, {bytes_text(size)}"
    start_ns, end_ns = plan["start_ns"], plan["end_ns"]
    if start_ns is not None and end_ns is not None:
        text += f", {time_text(start_ns)} .. {time_text(end_ns)} UTC"
        text += f" ({seconds_text((end_ns - start_ns) / 1e9)})"
    read_from_ns, read_until_ns = plan["read_from_ns"], plan["read_until_ns"]
    if read_from_ns is not None or read_until_ns is not None:
        text += f", read from {time_text(read_from_ns)} until {time_text(read_until_ns)}"
    return text


def _relative(folder: Path, path: str) -> str:
    return path if is_url(path) else normpath(folder / path)


def _sample_text(sample: Sample) -> Text:
    if not sample.read:
        return Text("none", style="dim")
    if sample.rejected:
        return Text(f"{sample.rejected} of {sample.read} rejected", style="red")
    return Text(f"{sample.read} accepted", style="green")


def _print_notes(notes: Sequence[Note]) -> None:
    for note in _grouped(notes):
        location = f"{note.location}: " if note.location else ""
        hint = f" — {note.help}" if note.help else ""
        line = f"{location}{note.severity.value}[{note.rule}] {note.message}{hint}"
        print_line(line, style=NOTE_STYLES[note.severity])


def _grouped(notes: Sequence[Note]) -> Iterator[Note]:
    """Yield the notes, with one for all topics that are excluded for the same reason."""
    topics: dict[tuple[Severity, str], list[str]] = {}
    for note in notes:
        if note.rule == "skipped-topic":
            topic, _, reason = note.message.partition(": ")
            topics.setdefault((note.severity, reason), []).append(topic)
    for note in notes:
        _, _, reason = note.message.partition(": ")
        names = topics.get((note.severity, reason), []) if note.rule == "skipped-topic" else []
        if len(names) <= 1:
            yield note
        elif note.message.startswith(f"{names[0]}: "):
            message = f"{counted(len(names), 'topic')} {reason}: {join_names(names)}"
            yield note.model_copy(update={"message": message})


def _print_destination(state: DestinationState, sequence: Mapping[str, Any], destination: str) -> None:
    name = f"{state.kind} {destination}"
    if state.problem is not None:
        print_line(f"{name} refuses: {state.problem}", style="bold red")
        return
    if state.exists is None:
        print_line(f"{name}: not checked; use --connect to check it", style="dim")
        return
    if not state.exists:
        action = "will be created"
    elif state.has_sequence:
        action = f"contains {sequence['name']}; action: {sequence['if_exists']}"
    else:
        action = "ready"
    space = ""
    if state.free_bytes is not None:
        estimate = state.estimated_bytes
        needed = "" if estimate is None else f", at most {bytes_text(estimate)} needed"
        space = f" ({bytes_text(state.free_bytes)} free{needed})"
    print_line(f"{name}: {action}{space}", style="green")


def diff(
    before: Annotated[Path, typer.Argument(metavar="BEFORE.yaml", help="A job manifest.")],
    after: Annotated[Path, typer.Argument(metavar="AFTER.yaml", help="The manifest to compare it with.")],
    as_json: JsonOption = False,
) -> None:
    """Compare the plans of two manifests: topics, adapters, metadata and destination.

    Exit codes: 0 the plans are equal, 1 they differ.
    """
    from msgspec import to_builtins

    from mosaico_ingest import api

    differences = api.compare_jobs(before, after)
    if as_json:
        print_json([to_builtins(difference) for difference in differences])
    else:
        print_differences(differences)
    if differences:
        raise typer.Exit(1)


def print_differences(differences: Sequence[Difference]) -> None:
    """Print a line for each difference: added in green, removed in red, changed in yellow."""
    for difference in differences:
        style = "green" if difference.before is None else "red" if difference.after is None else "yellow"
        print_line(str(difference), style=style)
    if not differences:
        print_line("the plans are equal", style="green")


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


def _cell_comment(manifest: Path, job: Expanded) -> str:
    cell = ", ".join(f"{name}={value}" for name, value in job.cell.items())
    return f"# {manifest}: {cell}\n" if cell else ""


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
    from mosaico_ingest.services.inspection import draft_manifest

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
