"""`ingest plan` and `diff`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
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
    output_file,
)
from mosaico_ingest.display import bytes_text, counted, seconds_text, time_text
from mosaico_ingest.errors import IngestError, gravest
from mosaico_ingest.findings import Severity, join_names
from mosaico_ingest.lazy import LazySequence
from mosaico_ingest.remote import is_url

if TYPE_CHECKING:
    from mosaico_ingest.pipeline.plan_document import (
        DestinationState,
        Difference,
        Note,
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
            "--out",
            help="Write the plan as JSON, or JSON Lines (FILE.jsonl), for `run --plan`; - writes it to stdout.",
            metavar="FILE",
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
    from mosaico_ingest.cli.check import CheckedRecording, CiFiles
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas

    collect_garbage_as_usual()
    prints = out != STANDARD_OUTPUT and not as_json  # tables would mix with the JSON
    with CiFiles(junit, sarif) as ci:
        try:
            jobs = api.compile_job(manifest)
            hide_pandas(jobs)
            shown = (
                PlanTables(manifest.parent, prints=prints)
                if check is None
                else PlanDifferences(check, prints=prints)
            )
            with _documents(manifest, out, as_json=as_json) as write:
                for recording in api.plan_recordings(manifest, jobs=jobs, connect=connect):
                    write(recording)
                    ci.add(CheckedRecording(recording.plan["sequence"]["name"], recording.contract))
                    shown.add(recording)
        except IngestError as error:
            ci.add(CheckedRecording(str(manifest), None, str(error), error.findings))
            raise
    code = shown.finish()
    if code:
        raise typer.Exit(code)


@contextmanager
def _documents(
    manifest: Path, out: Path | None, *, as_json: bool
) -> Generator[Callable[[RecordingPlan], None]]:
    """Yield the function that writes a recording to the plan file, to standard output, or to both.

    If recordings cannot be planned, the file is not written, and the document on standard output has the others.
    """
    from mosaico_ingest.pipeline.plan_document import LINES_SUFFIX, PlanWriter
    from mosaico_ingest.pipeline.preview import plan_frame

    frame = plan_frame(manifest, out.parent if out else Path())
    writers: list[PlanWriter] = []

    def write(recording: RecordingPlan) -> None:
        for writer in writers:
            writer.add(recording)

    with ExitStack() as stack:
        if out is not None:
            is_lines = out.suffix == LINES_SUFFIX
            writers.append(PlanWriter(stack.enter_context(output_file(out)), frame, lines=is_lines))
        if as_json and out != STANDARD_OUTPUT:
            writers.append(PlanWriter(sys.stdout.write, frame))
        try:
            yield write
        except IngestError:
            for writer in writers:
                if writer.has_items:
                    writer.finish()
            raise
        for writer in writers:
            writer.finish()


class PlanTables:
    """Prints the plan of each recording, with paths relative to `folder`, the manifest's folder."""

    def __init__(self, folder: Path, *, prints: bool = True) -> None:
        self._folder, self._prints = folder, prints
        self._count = self._bytes = 0
        self._codes: set[int] = set()

    def add(self, recording: RecordingPlan) -> None:
        """Print the plan of a recording."""
        self._count += 1
        self._bytes += sum(file["size_bytes"] for file in recording.plan["files"])
        self._codes.add(recording.exit_code)
        if self._prints:
            _print_recording(recording, self._folder)

    def finish(self) -> int:
        """Print the number and size of the recordings if there are several, and return the exit code."""
        if self._prints and self._count > 1:
            print_line(f"{counted(self._count, 'recording')}, {bytes_text(self._bytes)}", style="bold")
        return gravest(self._codes)


class PlanDifferences:
    """Prints the differences of the plans from those of a plan file."""

    def __init__(self, file: Path, *, prints: bool) -> None:
        from mosaico_ingest.pipeline.plan_document import PlanComparison, read_plan

        before = LazySequence.of(read_plan(file).recordings).map(_plan_of)
        self._comparison = PlanComparison(before)
        self._prints = prints
        self._count = 0

    def add(self, recording: RecordingPlan) -> None:
        """Print the differences of the plan of a recording."""
        self._print(self._comparison.add(recording.plan))

    def finish(self) -> int:
        """Print the differences of new and missing recordings, and return the exit code."""
        self._print(self._comparison.finish())
        if self._prints and not self._count:
            _print_equal()
        return int(self._count > 0)

    def _print(self, differences: Iterable[Difference]) -> None:
        for difference in differences:
            self._count += 1
            if self._prints:
                _print_difference(difference)


def _plan_of(recording: RecordingPlan) -> Mapping[str, Any]:
    return recording.plan


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
        for difference in differences:
            _print_difference(difference)
        if not differences:
            _print_equal()
    if differences:
        raise typer.Exit(1)


def _print_difference(difference: Difference) -> None:
    """Print a difference: added in green, removed in red, changed in yellow."""
    style = "green" if difference.before is None else "red" if difference.after is None else "yellow"
    print_line(str(difference), style=style)


def _print_equal() -> None:
    print_line("the plans are equal", style="green")
