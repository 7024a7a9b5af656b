"""This file is the way in: an adapter file becomes an adapter, or all that is wrong with it is said at once."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from pydantic import ValidationError

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.mapping.checker import Analyzer, Scope
from mosaico_ingest.adapters.mapping.column_plan import ColumnPlan, evaluate_column
from mosaico_ingest.adapters.mapping.compiler import AdapterLookup, Compiler
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, Rejection, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import TypedExpression
from mosaico_ingest.adapters.mapping.model import InlineType, MappingFile, inline_ontology_type
from mosaico_ingest.adapters.mapping.types import ExprType
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import Finding, RowFailure, Severity
from mosaico_ingest.ontology.registry import UnknownTag, ontology_type
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import Definition, MessageType, normalize_msgtype
from mosaico_ingest.textfile import read_whole

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import Source

__all__ = ["MappingAdapter", "MappingSpec", "adapter_from_model", "load_adapter"]

_BINDING: ContextVar[tuple[tuple[str, str], ...]] = ContextVar("binding", default=())
"""The adapters being bound and the types they are bound to, to notice one that uses itself."""


_MOST_BOUND = 64
_Known: TypeAlias = tuple[str, int, tuple[MessageType, ...]]
"""All of a definition that decides how a mapping is compiled."""


class MappingAdapter(Struct, frozen=True):
    """A mapping bound to one message definition; satisfies `Adapter`."""

    ontology: OntologyType
    record: ColumnPlan
    metadata: dict[str, TypedExpression]
    msgtype: str

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a whole batch; a row that does not fit is a failure, the others go on."""
        try:
            adapted = evaluate_column(Evaluation(rows, envelope), self.record)
        except RowsRejected as refused:
            return self._adapt_others(rows, envelope, refused.refusals)
        return Adapted(adapted, np.arange(len(rows), dtype=np.int64), ())

    def _adapt_others(self, rows: Any, envelope: Envelope, refusals: dict[int, Rejection]) -> Adapted:  # noqa: ANN401 - an Arrow array
        """Adapt the rows that were not refused; each round finds at least one of what is wrong with a batch."""
        good = np.ones(len(rows), bool)
        good[list(refusals)] = False
        others = replace(envelope, log_times=envelope.log_times[good])
        adapted = self.adapt(rows.filter(pa.array(good)), others)
        index = np.flatnonzero(good).astype(np.int64)
        failures = [RowFailure(row, rule, reason) for row, (rule, reason) in refusals.items()]
        failures += [replace(failure, row=int(index[failure.row])) for failure in adapted.failures]
        failures.sort(key=lambda failure: failure.row)
        return Adapted(adapted.rows, index[adapted.index], tuple(failures))

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return the values of `schema_metadata` for one row; {} without one, or where it does not fit."""
        if first_row is None or not self.metadata:
            return {}
        row: Any = pa.array([first_row.as_py()], first_row.type)
        evaluation = Evaluation(row, Envelope("", self.msgtype, np.zeros(1, np.int64)))
        try:
            return {
                key: evaluation.evaluate(typed).close_all(1)[0].as_py()
                for key, typed in self.metadata.items()
            }
        except RowsRejected:
            return {}


@dataclass(frozen=True, slots=True)
class MappingSpec:
    """An adapter file that reads well; satisfies `AdapterSpec`, and survives pickling if its look-up does."""

    model: MappingFile
    origin: Source | Path
    """Its text and the place of everything in it, or the file that has them."""
    ontology: OntologyType
    adapters: AdapterLookup | None = None
    """Finds the adapters that `use` names; a module-level function."""
    _bound: dict[_Known, MappingAdapter] = field(
        default_factory=dict["_Known", "MappingAdapter"], compare=False, repr=False
    )
    """What it has been compiled to: a batch has the same few types in each of its recordings."""

    @property
    def source(self) -> Source:
        """Its text and the place of everything in it; read now where only its file is known."""
        return _source(self.origin) if isinstance(self.origin, Path) else self.origin

    @property
    def name(self) -> str:
        """As `IMUAdapter`."""
        return self.model.adapter

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types it takes, as `sensor_msgs/msg/Imu`."""
        return tuple(normalize_msgtype(name) for name in self.model.ros_types)

    @property
    def default(self) -> bool:
        """Whether it is used for its types without being asked for."""
        return self.model.default

    def own_text(self, msgtype: str) -> str | None:
        """Return the `.msg` text the file gives of a type; it can only be that of the first it takes."""
        return self.model.definition if msgtype == self.ros_types[0] else None

    def check(self, definition: Definition, shape: pa.StructType) -> tuple[Finding, ...]:
        """Return every mistake the mapping has for a message type; none means that it binds."""
        return self._compile(definition, shape)[1]

    def bind(self, definition: Definition, shape: pa.StructType) -> MappingAdapter:
        """Check the mapping against the real definition and compile it.

        Raises:
            AdapterError: It does not fit; `findings` has one for each mistake, with its place in the file.
        """
        known = _known(definition)
        if known in self._bound:
            return self._bound[known]
        adapter, findings = self._compile(definition, shape)
        if adapter is None or findings:
            raise _refused(f"{self.name} does not fit {definition.root}", self.source, findings)
        if len(self._bound) < _MOST_BOUND:
            self._bound[known] = adapter
        return adapter

    def __reduce__(self) -> tuple[type[MappingSpec], tuple[object, ...]]:
        """Leave what was compiled behind: it is quickly made anew, and large."""
        return MappingSpec, (self.model, self.origin, self.ontology, self.adapters)

    def _compile(
        self, definition: Definition, shape: pa.StructType
    ) -> tuple[MappingAdapter | None, tuple[Finding, ...]]:
        variant = next((n for n in self.model.ros_types if normalize_msgtype(n) == definition.root), None)
        if variant is None:
            where = self.source.key_span(("variants",) if self.model.variants else ("ros_type",))
            takes = f"{self.name} takes {', '.join(self.ros_types)}, not {definition.root}"
            return None, (Finding("type-mismatch", Severity.ERROR, takes, where),)
        step, chain = (self.name, definition.root), _BINDING.get()
        if step in chain:
            names = " → ".join(name for name, _ in (*chain[chain.index(step) :], step))
            where = self.source.key_span(("adapter",))
            return None, (
                Finding("adapter-cycle", Severity.ERROR, f"adapters use one another: {names}", where),
            )
        token = _BINDING.set((*chain, step))
        try:
            return self._compiled(definition, shape, variant)
        finally:
            _BINDING.reset(token)

    def _compiled(
        self, definition: Definition, shape: pa.StructType, variant: str
    ) -> tuple[MappingAdapter | None, tuple[Finding, ...]]:
        analyzer = Analyzer(lambda: self.source)
        compiler = Compiler(analyzer, definition, self.adapters)
        scope = Scope(ExprType(shape, msgtype=definition.root), definition.types)
        record = compiler.record(self.model, self.ontology, scope, variant)
        metadata = compiler.metadata(self.model.schema_metadata, scope)
        if record is None:
            return None, tuple(analyzer.findings)
        return MappingAdapter(self.ontology, record, metadata, definition.root), tuple(analyzer.findings)


def _known(definition: Definition) -> _Known:
    return definition.root, definition.ros_version, tuple(definition.types.values())


def load_adapter(
    path_or_text: Path | str, *, file: str | None = None, adapters: AdapterLookup | None = None
) -> MappingSpec:
    """Read an adapter file (`Path`) or its text (`str`, called `file` in messages).

    Raises:
        AdapterError: It cannot be read or is not a mapping; `findings` has one for each mistake.
    """
    source = _source(path_or_text, file)
    spec, findings = _read(source, adapters)
    if spec is None or findings:
        raise _refused("this is no valid adapter", source, findings)
    return spec


def adapter_from_model(value: object, path: Path, *, adapters: AdapterLookup) -> MappingSpec:
    """Return the adapter that `value`, read from the file at `path`, is known to be: what is in the file is not checked."""
    model = MappingFile.model_validate(value)
    return MappingSpec(model, path, ontology_type(str(model.ontology)), adapters)


def _source(path_or_text: Path | str, file: str | None = None) -> Source:
    from mosaico_ingest.job.yaml_source import load_source  # noqa: PLC0415 - built-in adapters are known without YAML

    if isinstance(path_or_text, Path):
        file = file or str(path_or_text)
        try:
            path_or_text = read_whole(path_or_text).decode()
        except OSError as error:
            raise AdapterError(f"the adapter file cannot be read: {error.strerror}", where=file) from error
        except UnicodeDecodeError as error:
            raise AdapterError(f"the adapter file is no UTF-8: {error}", where=file) from error
    return load_source(path_or_text, file=file or "<adapter>")


def _read(source: Source, adapters: AdapterLookup | None) -> tuple[MappingSpec | None, tuple[Finding, ...]]:
    if source.findings:
        return None, source.findings
    try:
        model = MappingFile.model_validate(source.value)
    except ValidationError as error:
        from mosaico_ingest.adapters.mapping.model import adapter_schema  # noqa: PLC0415 - brings the manifest's models
        from mosaico_ingest.job.validation import explain  # noqa: PLC0415 - the same

        return None, tuple(finding for _, finding in explain(error, source=source, schema=adapter_schema()))
    analyzer = Analyzer(lambda: source)
    if (model.ros_type is None) == (model.variants is None):
        analyzer.report(
            ("adapter",), "either ros_type or variants says what the adapter takes", "give one of them"
        )
    ontology = _ontology(model, analyzer)
    if ontology is None:
        return None, tuple(analyzer.findings)
    compiler = Compiler(analyzer, None, adapters)
    compiler.record(model, ontology, None, None)
    compiler.metadata(model.schema_metadata, None)
    return MappingSpec(model, source, ontology, adapters), tuple(analyzer.findings)


def _ontology(model: MappingFile, analyzer: Analyzer) -> OntologyType | None:
    if isinstance(model.ontology, InlineType):
        return inline_ontology_type(model.ontology, analyzer.report)
    try:
        return ontology_type(model.ontology)
    except UnknownTag as unknown:
        analyzer.report(("ontology",), unknown.what, unknown.hint, rule="unknown-ontology")
        return None


def _refused(what: str, source: Source, findings: tuple[Finding, ...]) -> AdapterError:
    first = findings[0] if findings else None
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    said = f"{what}: {first.message}{more}" if first else what
    where = str(first.span) if first and first.span else source.file
    return AdapterError(said, where=where, hint=first.help if first else None, findings=findings)
