"""The plan document: plans of all recordings of a manifest with samples, its file format, and its comparison."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from msgspec import Struct
from pydantic import AfterValidator, Field, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from mosaico_ingest.display import count_text
from mosaico_ingest.documents import (
    JsonListWriter,
    LineFile,
    Part,
    html_table,
    read_document,
    read_limited,
)
from mosaico_ingest.errors import ManifestError, gravest
from mosaico_ingest.findings import Finding, Severity, Stage
from mosaico_ingest.lazy import LazySequence
from mosaico_ingest.pipeline.plan import Plan, plan_headline
from mosaico_ingest.report.parts import ContractResult

Json: TypeAlias = Any
_NAMES = {"topics": ("topic", "target"), "excluded": ("excluded topic", "topic"), "files": ("file", "path")}
"""For each list of a plan, the name of its items and the key that identifies an item."""
PlanJson: TypeAlias = Mapping[str, Any]
"""A serialized plan, see `Plan.document`."""
MAX_ADDED = 1000
"""Plans of new sequences that are compared with plans of the same files under another name."""
LINES_SUFFIX = ".jsonl"
"""The suffix of plan files in JSON Lines."""
_HINT = "create a plan with `ingest plan job.yaml --out plan.json`"
_Model = TypeVar("_Model", bound=Part)
_Change: TypeAlias = "tuple[str, str | None, str | None]"
"""Key path, text before, text after."""


class Note(Part):
    """A finding, with its location as text."""

    severity: Severity
    rule: str
    message: str
    location: str | None
    """The location, such as `job.yaml:3:5`."""
    help: str | None


class SampleRejection(Part):
    """Sampled messages that would be rejected for the same reason."""

    stage: Stage
    rule: str
    count: int
    reason: str


class Sample(Part):
    """The first messages of a topic, decoded and adapted without being written."""

    target: str
    """The topic's name in the sequence."""
    count: int | None = None
    """The number of messages in the time range, according to the recording's index; null if it is unknown."""
    read: int
    rejected: int
    row_bytes: int | None
    """Uncompressed bytes per row; None if no message was adapted."""
    rejections: tuple[SampleRejection, ...]


class DestinationState(Part):
    """The state of the destination; null for a value that is unknown."""

    kind: str
    """`store`, `server`, or the type of an installed destination."""
    exists: bool | None
    """Whether the store exists or the server responds."""
    has_sequence: bool | None
    """Whether the destination has a sequence of this name."""
    problem: str | None
    """The reason why the sequence cannot be written."""
    free_bytes: int | None
    estimated_bytes: int | None
    """Uncompressed bytes of all rows, estimated from the samples; compression usually reduces them."""


class _SerializedPlan:
    """Marks a field that holds `Plan.document`."""

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Describe the serialized plan."""
        del schema
        Plan.model_rebuild()
        return handler(Plan.__pydantic_core_schema__)


class RecordingPlan(Part):
    """The plan of one recording, with the state of its destination and the result of its samples."""

    digest: str
    """Identifies the plan; `ingest run --plan` runs no other one."""
    plan: Annotated[dict[str, Any], _SerializedPlan()]
    """The serialized plan, see `Plan.document`."""
    destination: DestinationState
    samples: tuple[Sample, ...]
    contract: ContractResult | None = None
    """The results of the expectations that the index of the recording decides or that the sample violates."""
    notes: tuple[Note, ...]

    @property
    def rejected(self) -> int:
        """The number of sampled messages that would be rejected."""
        return sum(sample.rejected for sample in self.samples)

    @property
    def violates_contract(self) -> bool:
        """Whether a run would fail or be diverted because of its data contract."""
        return self.contract is not None and not self.contract.passed and self.contract.on_failure != "warn"

    @property
    def is_empty(self) -> bool:
        """Whether the index has no message of any selected topic in the time range."""
        has_latched = any(topic["latched"] for topic in self.plan["topics"])
        return not has_latched and all(sample.count == 0 for sample in self.samples)

    @property
    def exit_code(self) -> int:
        """The exit code of the recording's plan.

        1 if the destination refuses, 6 if the data contract is violated and `expect.on_failure` is not `warn`, 3 if the
        recording has no message, 4 if sampled messages would be rejected, else 0.
        """
        if self.destination.problem:
            return 1
        if self.violates_contract:
            return 6
        if self.is_empty:
            return 3
        return 4 if self.rejected else 0

    @property
    def count_texts(self) -> dict[str, str]:
        """The number of messages by the topic's name in the sequence, such as `2,110`, `600 of 2,110` or `?`."""
        samples = {sample.target: sample.count for sample in self.samples}
        has_range = (self.plan["read_from_ns"], self.plan["read_until_ns"]) != (None, None)
        texts: dict[str, str] = {}
        for topic in self.plan["topics"]:
            count, total = (_count_text(n) for n in (samples[topic["target"]], topic["count"]))
            texts[topic["target"]] = f"{count} of {total}" if has_range else total
        return texts


class _Header(Part):
    """The first line of a plan in JSON Lines."""

    version: Literal[1] = 1
    tool: str
    job: str


class PlanDocument(Part):
    """The plans of all recordings of a manifest; `version` changes with the format."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote the document."""
    job: str = Field(examples=["job.yaml"])
    """The manifest, relative to this file's folder."""
    recordings: Annotated[Sequence[RecordingPlan], AfterValidator(tuple)]

    def __repr__(self) -> str:
        """Return the counts of each plan, one line per recording."""
        return "\n".join(f"<Plan {self._headline(recording)}>" for recording in self.recordings) or "<Plan>"

    def _repr_html_(self) -> str:
        """Return a table of the topics of each recording for a notebook."""
        names = ("topic", "type", "messages", "becomes", "because")
        return "".join(
            html_table(
                f"Plan {self._headline(recording)}",
                names,
                (
                    (
                        topic["topic"],
                        topic["msgtype"],
                        recording.count_texts[topic["target"]],
                        topic["ontology"]["tag"],
                        topic["why"],
                    )
                    for topic in recording.plan["topics"]
                ),
                count=len(recording.plan["topics"]),
                numbers={"messages"},
                notes=[f"{note.severity.value}[{note.rule}] {note.message}" for note in recording.notes],
            )
            for recording in self.recordings
        )

    @staticmethod
    def _headline(recording: RecordingPlan) -> str:
        plan = recording.plan
        shared = {topic["target"] for topic in plan["topics"] if topic["shares_messages"]}
        counts = [sample.count for sample in recording.samples if sample.target not in shared]
        return plan_headline(plan["sequence"]["name"], counts, len(plan["excluded"]))

    @property
    def exit_code(self) -> int:
        """The first of 1, 6, 3, 4, 0 that any recording has."""
        return gravest({recording.exit_code for recording in self.recordings})


class PlanWriter:
    """Writes a plan document recording by recording: as JSON, or as JSON Lines with a header."""

    def __init__(self, write: Callable[[str], object], frame: PlanDocument, *, lines: bool = False) -> None:
        self._write, self._header = write, _Header(tool=frame.tool, job=frame.job) if lines else None
        self._list = JsonListWriter(write, frame.model_dump_json(indent=2))

    @property
    def has_items(self) -> bool:
        """Whether a recording was written."""
        return self._list.has_items

    def add(self, recording: RecordingPlan) -> None:
        """Write the plan of a recording."""
        if self._header is None:
            self._list.add(recording.model_dump_json(indent=2))
            return
        if not self._list.has_items:
            self._write(self._header.model_dump_json() + "\n")
            self._list.has_items = True
        self._write(recording.model_dump_json() + "\n")

    def finish(self) -> None:
        """Write the end of the document."""
        if self._header is None:
            self._list.finish()


def read_plan(path: Path) -> PlanDocument:
    """Read a plan file; the recordings of a file in JSON Lines are read at each access.

    Raises:
        ManifestError: The file cannot be read or violates the schema of plans.
    """
    try:
        if path.suffix == LINES_SUFFIX:
            return _read_lines(path)
        content = read_limited(path)
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path), hint=_HINT) from error
    return read_document(content, PlanDocument, where=str(path), kind="a plan", hint=_HINT)


def _read_lines(path: Path) -> PlanDocument:
    """Return the plan document in JSON Lines; only the offsets of its lines are kept."""
    offsets = array("q")
    with path.open("rb") as file:
        header = _parse_line(path, 0, file.readline(), _Header)
        offset = file.tell()
        for line in file:
            offsets.append(offset)
            offset += len(line)
    lines = LineFile(path)

    def recording(position: int) -> RecordingPlan:
        offset = offsets[position]
        return _parse_line(path, offset, lines.read(offset), RecordingPlan)

    recordings = LazySequence(recording, range(len(offsets)), ())
    return PlanDocument.model_construct(tool=header.tool, job=header.job, recordings=recordings)


def _parse_line(path: Path, offset: int, line: bytes, model: type[_Model]) -> _Model:
    try:
        return model.model_validate_json(line)
    except ValidationError:
        return read_document(line, model, where=f"{path}: byte {offset}", kind="a plan", hint=_HINT)


def _count_text(count: int | None) -> str:
    return "?" if count is None else count_text(count)


def notes(findings: Iterable[Finding]) -> tuple[Note, ...]:
    """Return findings in the form of a document."""
    return tuple(
        Note(
            severity=finding.severity,
            rule=finding.rule,
            message=finding.message,
            location=str(finding.span) if finding.span else None,
            help=finding.help,
        )
        for finding in findings
    )


class Difference(Struct, frozen=True):
    """One difference between two plans; None for a value that one of them does not have."""

    sequence: str
    name: str
    """The key path of the value, such as `topic /imu every`."""
    before: str | None
    after: str | None

    def __str__(self) -> str:
        """Return the difference in one line."""
        if self.before is None:
            return f"{self.sequence}: + {self.name}: {self.after}"
        if self.after is None:
            return f"{self.sequence}: - {self.name}: {self.before}"
        return f"{self.sequence}: {self.name}: {self.before} → {self.after}"


class PlanComparison:
    """Compares plans one by one with the plans of another document.

    Plans are compared with each other if they have the same sequence name, or else the same files.
    """

    def __init__(self, before: Sequence[PlanJson]) -> None:
        self._before = before
        self._positions: dict[str, list[int]] = {}
        for position, plan in enumerate(before):
            self._positions.setdefault(_sequence(plan), []).append(position)
        self._added: list[PlanJson] = []
        """At most `MAX_ADDED` plans without an earlier plan of the same name."""

    def add(self, plan: PlanJson) -> list[Difference]:
        """Return the differences of a plan from the earlier plan of its sequence, if there is one."""
        positions = self._positions.get(_sequence(plan))
        if positions:
            return list(_compare(self._before[positions.pop(0)], plan))
        if len(self._added) >= MAX_ADDED:
            return [_one_side(None, plan)]
        self._added.append(plan)
        return []

    def finish(self) -> Iterator[Difference]:
        """Yield the differences of the plans whose sequences are in one of the documents only."""
        missing = sorted(position for positions in self._positions.values() for position in positions)
        for position in missing:
            old = self._before[position]
            same = [plan for plan in self._added if plan["files"] == old["files"]]
            is_only_pair = len(self._added) == len(missing) == 1
            new = same[0] if same else self._added[0] if is_only_pair else None
            if new is None:
                yield _one_side(old, None)
            else:
                self._added.remove(new)
                yield from _compare(old, new)
        yield from (_one_side(None, plan) for plan in self._added)


def differences(before: Sequence[PlanJson], after: Iterable[PlanJson]) -> tuple[Difference, ...]:
    """Return the differences between the plans of two documents; see `PlanComparison`."""
    comparison = PlanComparison(before)
    changes = [difference for plan in after for difference in comparison.add(plan)]
    return (*changes, *comparison.finish())


def _sequence(plan: PlanJson) -> str:
    return plan["sequence"]["name"]


def _one_side(old: PlanJson | None, new: PlanJson | None) -> Difference:
    def summary(plan: PlanJson | None) -> str | None:
        if plan is None:
            return None
        return f"{', '.join(file['path'] for file in plan['files'])}, {len(plan['topics'])} topics"

    plan = old or new
    return Difference(_sequence(plan) if plan else "", "recording", summary(old), summary(new))


def _compare(old: PlanJson, new: PlanJson) -> Iterator[Difference]:
    for name, before, after in _compare_mappings("", old, new):
        yield Difference(_sequence(old), name, before, after)


def _compare_mappings(name: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Change]:
    for key in dict.fromkeys((*old, *new)):
        inner = f"{name} {key}".strip()
        if key not in old or key not in new:
            yield inner, _text(old.get(key)), _text(new.get(key))
        else:
            yield from _compare_values(inner, key, old[key], new[key])


def _compare_values(name: str, key: str, old: Json, new: Json) -> Iterator[_Change]:
    if old == new:
        return
    if isinstance(old, dict) and isinstance(new, dict):
        yield from _compare_mappings(name, old, new)
    elif key in _NAMES:
        kind, identity = _NAMES[key]
        yield from _compare_items(
            kind, {item[identity]: item for item in old}, {item[identity]: item for item in new}
        )
    else:
        yield name, _text(old) or "none", _text(new) or "none"


def _compare_items(kind: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Change]:
    for identity in dict.fromkeys((*old, *new)):
        name = f"{kind} {identity}"
        if identity in old and identity in new:
            yield from _compare_mappings(name, old[identity], new[identity])
        else:
            yield name, _item_text(old.get(identity)), _item_text(new.get(identity))


def _item_text(item: Mapping[str, Json] | None) -> str | None:
    if item is None:
        return None
    if "adapter" in item:
        return f"{item['msgtype']} by {item['adapter']['name']} to {item['ontology']['tag']}"
    return item["why"] if "why" in item else f"{item['size_bytes']} bytes"


def _text(value: Json) -> str | None:
    if value is None or isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)
