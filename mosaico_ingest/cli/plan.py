"""`ingest plan`, `diff`, `expand` and `init`."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import normpath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from mosaico_ingest.cli.console import plain_table
from mosaico_ingest.cli.report import open_console
from mosaico_ingest.findings import Severity
from mosaico_ingest.remote import is_url
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    seconds_text,
    time_text,
)

if TYPE_CHECKING:
    from mosaico_ingest.job.expand import Expanded
    from mosaico_ingest.pipeline.plan import (
        Decisions,
        DestinationState,
        Difference,
        Note,
        PlanDocument,
        RecordingPlan,
        Sample,
    )

__all__ = [
    "diff",
    "expand",
    "init",
    "plan",
    "print_differences",
    "print_plan",
]

_STYLES = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.INFO: "dim"}


def print_plan(document: PlanDocument, *, folder: Path) -> None:
    """Print every recording of a plan, and how many there are; `folder` is the manifest's."""
    console = open_console()
    for recording in document.recordings:
        _print_recording(recording, folder, console)
    if len(document.recordings) > 1:
        total = sum(part.size_bytes for one in document.recordings for part in one.decisions.files)
        console.print(
            f"{len(document.recordings)} recordings, {bytes_text(total)}", highlight=False, style="bold"
        )


def print_differences(found: Sequence[Difference]) -> None:
    """Print what changes, a line for each."""
    console = open_console()
    for one in found:
        style = "green" if one.before is None else "red" if one.after is None else "yellow"
        console.print(Text(str(one), style=style), soft_wrap=True)
    if not found:
        console.print("the plans are the same", style="green")


def _print_recording(recording: RecordingPlan, folder: Path, console: Console) -> None:
    decided = recording.decisions
    place = decided.destination
    if recording.destination.kind == "store":
        place = _seen_from(folder, place)
    console.print(Text(f"{decided.sequence} → {place}", style="bold"))
    console.print(_source(decided, folder), soft_wrap=True)
    samples = {sample.target: sample for sample in recording.samples}
    names = ("topic", "type", "messages", "becomes", "adapter", "because", "sample")
    table = plain_table(*names, numbers={"messages"})
    for topic in decided.topics:
        renamed = "" if topic.target == topic.topic else f" → {topic.target}"
        every = "" if topic.every == 1 else f" / {topic.every}"
        count = "?" if topic.count is None else f"{count_text(topic.count)}{every}"
        table.add_row(
            f"{topic.topic}{renamed}",
            topic.msgtype,
            count,
            topic.ontology,
            topic.adapter,
            topic.why,
            _tried(samples[topic.target]),
        )
    console.print(table)
    for sample in recording.samples:
        _print_rejections(sample, console)
    _print_notes(recording.notes, console)
    if recording.is_empty:
        console.print(Text("there is no message in the topics taken", style="red"))
    console.print(_state(recording.destination, decided, place), soft_wrap=True)


def _source(decided: Decisions, folder: Path) -> str:
    size = sum(part.size_bytes for part in decided.files)
    names = ", ".join(_seen_from(folder, part.path) for part in decided.files)
    text = f"{names}: {decided.container} by its first bytes, {bytes_text(size)}"
    if decided.start_ns is not None and decided.end_ns is not None:
        text += f", {time_text(decided.start_ns)} .. {time_text(decided.end_ns)} UTC"
        text += f" ({seconds_text((decided.end_ns - decided.start_ns) / 1e9)})"
    if decided.read_from_ns is not None or decided.read_until_ns is not None:
        text += f", read from {time_text(decided.read_from_ns)} until {time_text(decided.read_until_ns)}"
    return text


def _seen_from(folder: Path, path: str) -> str:
    return path if is_url(path) else normpath(folder / path)


def _tried(sample: Sample) -> Text:
    if not sample.read:
        return Text("none", style="dim")
    if sample.rejected:
        return Text(f"{sample.rejected} of {sample.read} rejected", style="red")
    return Text(f"{sample.read} fit", style="green")


def _print_rejections(sample: Sample, console: Console) -> None:
    for lost in sample.rejections:
        line = (
            f"{sample.target}: {lost.count} of {sample.read} would be rejected [{lost.rule}]: {lost.reason}"
        )
        console.print(Text(line, style="red"), soft_wrap=True)


def _print_notes(notes: Sequence[Note], console: Console) -> None:
    for note in notes:
        place = f"{note.place}: " if note.place else ""
        remedy = f" — {note.help}" if note.help else ""
        line = f"{place}{note.severity.value}[{note.rule}] {note.message}{remedy}"
        console.print(Text(line, style=_STYLES[note.severity]), soft_wrap=True)


def _state(state: DestinationState, decided: Decisions, place: str) -> Text:
    """Say what the destination said."""
    name = f"{state.kind} {place}"
    if state.problem is not None:
        return Text(f"{name} refuses: {state.problem}", style="bold red")
    if state.exists is None:
        return Text(f"{name} was not asked; --connect does", style="dim")
    what = f"has {decided.sequence}, {decided.if_exists.value} it" if state.taken else "takes it"
    if not state.exists:
        what = "will be made"
    room = ""
    if state.free_bytes is not None:
        need = (
            "" if state.estimated_bytes is None else f", at most {bytes_text(state.estimated_bytes)} needed"
        )
        room = f" ({bytes_text(state.free_bytes)} free{need})"
    return Text(f"{name}: {what}{room}", style="green")


def diff(
    before: Annotated[Path, typer.Argument(metavar="BEFORE.yaml", help="A job manifest.")],
    after: Annotated[Path, typer.Argument(metavar="AFTER.yaml", help="The one to compare with it.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare what two manifests would do with their recordings: topics, adapters, metadata, target.

    Exit codes: 0 the plans are the same, 1 they differ.
    """
    import json

    from msgspec import to_builtins

    from mosaico_ingest import api
    from mosaico_ingest.cli.report import print_json

    found = api.compare_jobs(before, after)
    if as_json:
        print_json(json.dumps([to_builtins(one) for one in found], indent=2, ensure_ascii=False))
    else:
        print_differences(found)
    if found:
        raise typer.Exit(1)


def expand(
    manifest: Annotated[Path, typer.Argument(metavar="JOB.yaml", help="A job manifest.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list of the jobs.")] = False,
) -> None:
    """Print every job of a manifest as a manifest of its own; variables of the environment stay as they are.

    What another file says has a comment with its place; paths are seen from the manifest's folder.
    """
    import json

    from mosaico_ingest.cli.report import print_json
    from mosaico_ingest.job.expand import expand_manifest, to_yaml

    jobs = expand_manifest(manifest)
    if as_json:
        print_json(json.dumps([job.value for job in jobs], indent=2, ensure_ascii=False))
        return
    typer.echo(
        "---\n".join(f"{_head(manifest, job)}{to_yaml(job.value, job.remark)}" for job in jobs), nl=False
    )


def _head(manifest: Path, job: Expanded) -> str:
    cell = ", ".join(f"{name}={value}" for name, value in job.cell.items())
    return f"# {manifest}: {cell}\n" if cell else ""


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
    from mosaico_ingest.remote import as_path
    from mosaico_ingest.report.units import counted
    from mosaico_ingest.services.draft import draft_manifest
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


def plan(
    manifest: Annotated[Path, typer.Argument(metavar="JOB.yaml", help="A job manifest.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the plan as JSON, for `run --plan`.", metavar="FILE")
    ] = None,
    check: Annotated[
        Path | None, typer.Option("--check", help="Fail where the plan is not that of FILE.", metavar="FILE")
    ] = None,
    connect: Annotated[bool, typer.Option("--connect", help="Ask the server, if the target is one.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Decide everything against the real recording and try a few messages of each topic; write nothing.

    Exit codes: 0 the job can run, 1 it cannot or has drifted, 3 nothing matches, 4 messages would be rejected.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_as_usual, forgo_pandas
    from mosaico_ingest.cli.report import print_json
    from mosaico_ingest.pipeline.plan import write_plan

    collect_as_usual()
    configs = api.compile_job(manifest)
    forgo_pandas(configs)
    document = api.plan_job(manifest, configs=configs, folder=out.parent if out else None, connect=connect)
    if out is not None:
        write_plan(document, out)
    if as_json:
        print_json(document.model_dump_json(indent=2))
    elif check is None:
        print_plan(document, folder=manifest.parent)
    if check is not None:
        drift = api.plan_differences(check, document)
        if not as_json:
            print_differences(drift)
        code = 1 if drift else 0
    else:
        code = document.exit_code
    if code:
        raise typer.Exit(code)
