"""Load adapter files, and bind them to message definitions."""

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
from mosaico_ingest.adapters.mapping.analyzer import Analyzer
from mosaico_ingest.adapters.mapping.checker import Scope
from mosaico_ingest.adapters.mapping.column_plan import ColumnPlan, evaluate_column
from mosaico_ingest.adapters.mapping.compiler import AdapterLookup, Compiler
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, Rejection, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import TypedExpression
from mosaico_ingest.adapters.mapping.inline_ontology import inline_ontology_type
from mosaico_ingest.adapters.mapping.model import InlineType, MappingFile
from mosaico_ingest.adapters.mapping.types import ExprType
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import Finding, RowFailure, Severity
from mosaico_ingest.ontology.registry import UnknownTag, ontology_type
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import Definition, MessageType, normalize_msgtype
from mosaico_ingest.textfile import read_limited

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import Source

_BINDING: ContextVar[tuple[tuple[str, str], ...]] = ContextVar("binding", default=())
"""The adapters being bound with their message types, to detect adapters that use each other in a cycle."""
_MAX_CACHED_BINDINGS = 64
_BindingKey: TypeAlias = tuple[str, int, tuple[MessageType, ...], pa.StructType]
"""What the compiled mapping depends on: root type, ROS version, message types, type of the rows."""


class MappingAdapter(Struct, frozen=True):
    """A mapping bound to one message definition; implements `Adapter`."""

    ontology: OntologyType
    record: ColumnPlan
    metadata: dict[str, TypedExpression]
    msgtype: str

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a batch; rows that do not fit become failures."""
        try:
            adapted = evaluate_column(Evaluation(rows, envelope), self.record)
        except RowsRejected as error:
            return self._adapt_others(rows, envelope, error.rejections)
        return Adapted(adapted, np.arange(len(rows), dtype=np.int64), ())

    def _adapt_others(self, rows: Any, envelope: Envelope, rejections: dict[int, Rejection]) -> Adapted:  # noqa: ANN401 - an Arrow array
        """Adapt the rows that were not rejected; recursion ends because each round rejects at least one row."""
        accepted = np.ones(len(rows), bool)
        accepted[list(rejections)] = False
        others = replace(envelope, log_times=envelope.log_times[accepted])
        adapted = self.adapt(rows.filter(pa.array(accepted)), others)
        index = np.flatnonzero(accepted).astype(np.int64)
        failures = [RowFailure(row, rule, reason) for row, (rule, reason) in rejections.items()]
        failures += [replace(failure, row=int(index[failure.row])) for failure in adapted.failures]
        failures.sort(key=lambda failure: failure.row)
        return Adapted(adapted.rows, index[adapted.index], tuple(failures))

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return the values of `schema_metadata` for a row; {} without a row, or if the row does not fit."""
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
    """A valid adapter file; implements `AdapterSpec`. It can be pickled if its adapter lookup can."""

    model: MappingFile
    origin: Source | Path
    """The file's text with the locations of its values, or the path to read them from."""
    ontology: OntologyType
    adapters: AdapterLookup | None = None
    """Finds the adapters that `use` names."""
    _bindings: dict[_BindingKey, MappingAdapter] = field(
        default_factory=dict["_BindingKey", "MappingAdapter"], compare=False, repr=False
    )
    """Cache of compiled mappings: the recordings of a job share most of their message types."""

    @property
    def source(self) -> Source:
        """The file's text with the locations of its values; read now if only the path is known."""
        return _source(self.origin) if isinstance(self.origin, Path) else self.origin

    @property
    def name(self) -> str:
        """The adapter's name, such as `IMUAdapter`."""
        return self.model.adapter

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types that the adapter takes, such as `sensor_msgs/msg/Imu`."""
        return tuple(normalize_msgtype(name) for name in self.model.ros_types)

    @property
    def default(self) -> bool:
        """Whether the adapter applies to its types without an override."""
        return self.model.default

    def own_text(self, msgtype: str) -> str | None:
        """Return the `.msg` text that the file contains for a type; it can only contain that of the first type."""
        return self.model.definition if msgtype == self.ros_types[0] else None

    def check(self, definition: Definition, shape: pa.StructType) -> tuple[Finding, ...]:
        """Return the findings of the mapping for a message definition; without findings, it binds."""
        return self._compile(definition, shape)[1]

    def bind(self, definition: Definition, shape: pa.StructType) -> MappingAdapter:
        """Check the mapping against a message definition and compile it.

        Raises:
            AdapterError: The mapping does not fit; `findings` has one finding per mistake, with its location.
        """
        key = (definition.root, definition.ros_version, tuple(definition.types.values()), shape)
        if key in self._bindings:
            return self._bindings[key]
        adapter, findings = self._compile(definition, shape)
        if adapter is None or findings:
            raise _adapter_error(f"{self.name} does not fit {definition.root}", self.source, findings)
        if len(self._bindings) < _MAX_CACHED_BINDINGS:
            self._bindings[key] = adapter
        return adapter

    def __reduce__(self) -> tuple[type[MappingSpec], tuple[object, ...]]:
        """Pickle without the cache: compiled mappings are large and quickly rebuilt."""
        return MappingSpec, (self.model, self.origin, self.ontology, self.adapters)

    def _compile(
        self, definition: Definition, shape: pa.StructType
    ) -> tuple[MappingAdapter | None, tuple[Finding, ...]]:
        variant = next(
            (n for n in self.model.ros_types if normalize_msgtype(n) == normalize_msgtype(definition.root)),
            None,
        )
        if variant is None:
            location = self.source.span(("variants",) if self.model.variants else ("ros_type",))
            message = f"{self.name} takes {', '.join(self.ros_types)}, not {definition.root}"
            return None, (Finding("type-mismatch", Severity.ERROR, message, location),)
        step, chain = (self.name, definition.root), _BINDING.get()
        if step in chain:
            names = " → ".join(name for name, _ in (*chain[chain.index(step) :], step))
            location = self.source.span(("adapter",))
            message = f"adapters use each other in a cycle: {names}"
            return None, (Finding("adapter-cycle", Severity.ERROR, message, location),)
        token = _BINDING.set((*chain, step))
        try:
            return self._compile_variant(definition, shape, variant)
        finally:
            _BINDING.reset(token)

    def _compile_variant(
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


def load_adapter(
    path_or_text: Path | str, *, file: str | None = None, adapters: AdapterLookup | None = None
) -> MappingSpec:
    """Load an adapter file (`Path`) or its text (`str`, called `file` in messages).

    Raises:
        AdapterError: The file cannot be read or is not a valid adapter; `findings` has one finding per mistake.
    """
    source = _source(path_or_text, file)
    spec, findings = _load(source, adapters)
    if spec is None or findings:
        raise _adapter_error("this is not a valid adapter", source, findings)
    return spec


def adapter_from_model(value: object, path: Path, *, adapters: AdapterLookup) -> MappingSpec:
    """Return the adapter with the given content, which is trusted to be the content of the file at `path`."""
    model = MappingFile.model_validate(value)
    return MappingSpec(model, path, ontology_type(str(model.ontology)), adapters)


def _source(path_or_text: Path | str, file: str | None = None) -> Source:
    from mosaico_ingest.job.yaml_source import load_source  # noqa: PLC0415 - built-in adapters need no YAML parser

    if isinstance(path_or_text, Path):
        file = file or str(path_or_text)
        try:
            path_or_text = read_limited(path_or_text).decode()
        except OSError as error:
            raise AdapterError(f"the adapter file cannot be read: {error.strerror}", where=file) from error
        except UnicodeDecodeError as error:
            raise AdapterError(f"the adapter file is not UTF-8: {error}", where=file) from error
    return load_source(path_or_text, file=file or "<adapter>")


def _load(source: Source, adapters: AdapterLookup | None) -> tuple[MappingSpec | None, tuple[Finding, ...]]:
    if source.findings:
        return None, source.findings
    try:
        model = MappingFile.model_validate(source.value)
    except ValidationError as error:
        from mosaico_ingest.adapters.mapping.model import adapter_schema  # noqa: PLC0415 - imports the job's models
        from mosaico_ingest.job.validation import explain  # noqa: PLC0415 - imports the job's models

        return None, tuple(finding for _, finding in explain(error, source=source, schema=adapter_schema()))
    analyzer = Analyzer(lambda: source)
    if (model.ros_type is None) == (model.variants is None):
        message = "an adapter needs exactly one of ros_type and variants"
        analyzer.report(("adapter",), message, "give one of them")
    ontology = _ontology(model, analyzer)
    if ontology is None:
        return None, tuple(analyzer.findings)
    compiler = Compiler(analyzer, None, adapters)
    compiler.record(model, ontology, None, None)
    compiler.metadata(model.schema_metadata, None)
    return MappingSpec(model, source, ontology, adapters), tuple(analyzer.findings)


def _ontology(model: MappingFile, analyzer: Analyzer) -> OntologyType | None:
    if isinstance(model.ontology, InlineType):
        return inline_ontology_type(model.ontology, analyzer)
    try:
        return ontology_type(model.ontology)
    except UnknownTag as error:
        analyzer.report_value(("ontology",), error.what, error.hint, rule="unknown-ontology")
        return None


def _adapter_error(message: str, source: Source, findings: tuple[Finding, ...]) -> AdapterError:
    """Return the error for findings: its text shows the first one."""
    first = findings[0] if findings else None
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    text = f"{message}: {first.message}{more}" if first else message
    location = str(first.span) if first and first.span else source.file
    return AdapterError(text, where=location, hint=first.help if first else None, findings=findings)
