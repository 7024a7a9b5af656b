"""`ingest plan` and `diff`."""

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
    JsonOption,
    JunitOption,
    ManifestArgument,
    SarifOption,
    write_output,
)
from mosaico_ingest.display import bytes_text, counted, seconds_text, time_text
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import Severity, join_names
from mosaico_ingest.remote import is_url

if TYPE_CHECKING:
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
        from mosaico_ingest.cli.check import CheckedRecording, plan_outcomes, write_ci_files

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
