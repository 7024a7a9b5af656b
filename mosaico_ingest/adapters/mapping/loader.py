"""Load adapter files, bind them to message definitions, and list the message fields that they read."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from pydantic import ValidationError

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.mapping.checker import (
    CAST_TYPES,
    RESERVED_NAMES,
    Analyzer,
    Binding,
    Scope,
    typed_constant,
)
from mosaico_ingest.adapters.mapping.columns import DataType, ExprType, arrays, is_list, open_list, pt
from mosaico_ingest.adapters.mapping.compiler import AdapterLookup, Compiler
from mosaico_ingest.adapters.mapping.evaluator import (
    ColumnPlan,
    Evaluation,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    Rejection,
    RowsRejected,
    StructSource,
    evaluate_column,
)
from mosaico_ingest.adapters.mapping.expressions import (
    Cast,
    CloseList,
    Conditional,
    Constant,
    ElementAt,
    EnvelopeField,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    OuterValue,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.model import (
    FieldDeclaration,
    FieldType,
    InlineType,
    MappingFile,
    RecordModel,
    Scalar,
    records_of,
)
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import Finding, RowFailure, Severity
from mosaico_ingest.ontology.registry import MODULES, OntologyType, UnknownTag, ontology_type
from mosaico_ingest.rosbag.definitions.model import Definition, MessageType, normalize_msgtype

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import Source
if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath
_BINDING: ContextVar[tuple[tuple[str, str], ...]] = ContextVar("binding", default=())
"""The adapters being bound with their message types, to detect adapters that use each other in a cycle."""
_MAX_CACHED_BINDINGS = 64
_BindingKey: TypeAlias = tuple[str, int, tuple[MessageType, ...], pa.StructType]
"""What the compiled mapping depends on: root type, ROS version, message types, type of the rows."""
PLAIN_TYPES: dict[str, DataType] = {**CAST_TYPES, "string": arrays.string(), "binary": arrays.binary()}
_LIST = re.compile(r"list\[\s*(?P<element>.+?)\s*(,\s*(?P<size>\d+)\s*)?\]")
_ENVELOPE_COLUMN = "timestamp_ns"
_LIST_OF_STRUCTS = "list"
ReadPath: TypeAlias = "tuple[str, ...]"
"""The names that lead to a field, without marks for lists: `joints`, `name` for `joints[].name`."""
_Scopes: TypeAlias = "tuple[ReadPath, ...]"
"""The paths of the messages around an expression, outermost first; names are looked up in the last one."""


class _OutputRows(Struct, frozen=True):
    """The rows that one output has of a batch."""

    rows: Any
    """A struct array, whose members the stubs do not declare."""
    messages: NDArray[np.int64]
    """The position of each row's message in the batch."""
    dropped: NDArray[np.bool_]
    """Where `drop_when` is true."""


class MappingAdapter(Struct, frozen=True):
    """A mapping bound to one message definition; implements `Adapter`."""

    ontology: OntologyType
    record: ColumnPlan
    metadata: dict[str, TypedExpression]
    msgtype: str
    drops: tuple[TypedExpression, ...] = ()
    """Conditions of which one is enough to drop a message."""
    levels: int = 0
    """The number of lists around the records of a message; 0 for one record per message."""
    others: tuple[MappingAdapter, ...] = ()
    """The other outputs of the adapter file."""

    @property
    def is_plain(self) -> bool:
        """Whether each message that is not rejected becomes exactly one row."""
        return not (self.drops or self.levels or self.others)

    @property
    def inverse_problem(self) -> str | None:
        """The reason why no message can be restored from one row; None if it can."""
        if not (self.levels or self.others):
            return None
        cause = "several rows" if self.levels else "several topics"
        return f"the adapter converts each message to {cause}, so it has no inverse"

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a batch; rows that do not fit become failures."""
        if not self.is_plain:
            return self._adapt_outputs(rows, envelope)
        try:
            adapted = evaluate_column(Evaluation(rows, envelope), self.record)
        except RowsRejected as error:
            return self._adapt_others(rows, envelope, error.rejections)
        return Adapted(adapted, np.arange(len(rows), dtype=np.int64), ())

    def _adapt_others(self, rows: Any, envelope: Envelope, rejections: dict[int, Rejection]) -> Adapted:  # noqa: ANN401 - an Arrow array
        """Adapt the rows that were not rejected; recursion ends because each round rejects at least one row."""
        accepted = np.ones(len(rows), bool)
        accepted[list(rejections)] = False
        adapted = self.adapt(rows.filter(pa.array(accepted)), envelope.take(accepted))
        index = np.flatnonzero(accepted).astype(np.int64)
        failures = [RowFailure(row, rule, reason) for row, (rule, reason) in rejections.items()]
        failures += [replace(failure, row=int(index[failure.row])) for failure in adapted.failures]
        failures.sort(key=lambda failure: failure.row)
        return Adapted(adapted.rows, index[adapted.index], tuple(failures))

    def _adapt_outputs(self, rows: Any, envelope: Envelope) -> Adapted:  # noqa: ANN401 - an Arrow array
        """Adapt a batch to any number of rows per message; a message that one output rejects has no row in any."""
        accepted = np.ones(len(rows), bool)
        rejections: dict[int, Rejection] = {}
        while True:
            index = np.flatnonzero(accepted).astype(np.int64)
            part = rows if accepted.all() else rows.filter(pa.array(accepted))
            parts: list[_OutputRows] = []
            rejected: dict[int, Rejection] = {}
            for output in (self, *self.others):
                try:
                    parts.append(output._rows_of(part, envelope.take(accepted)))  # noqa: SLF001 - the same class
                except RowsRejected as error:  # noqa: PERF203 - one per output
                    rejected = {**error.rejections, **rejected}
            if not rejected:
                break
            rejections |= {int(index[row]): rejection for row, rejection in rejected.items()}
            accepted[list(rejections)] = False
        failures = tuple(RowFailure(row, *rejections[row]) for row in sorted(rejections))
        dropped = _dropped(parts, index)
        first, *others = [Adapted(one.rows, index[one.messages], failures, dropped=dropped) for one in parts]
        return replace(first, others=tuple(others))

    def _rows_of(self, rows: Any, envelope: Envelope) -> _OutputRows:  # noqa: ANN401 - an Arrow array
        """Return the rows of this output.

        Raises:
            RowsRejected: Some messages do not fit.
        """
        evaluation = Evaluation(rows, envelope)
        dropped = np.zeros(len(rows), bool)
        for condition in self.drops:
            dropped |= evaluation.mask(condition)
        messages = np.flatnonzero(~dropped)
        try:
            values = evaluate_column(
                evaluation.subset(~dropped) if dropped.any() else evaluation, self.record
            )
        except RowsRejected as error:
            raise RowsRejected(
                {int(messages[row]): rejection for row, rejection in error.rejections.items()}
            ) from None
        for _ in range(self.levels):
            values, axis = open_list(values)
            messages = messages[axis.parents]
        if values.null_count:  # a null element of a list has no row
            present = values.is_valid()
            values, messages = values.filter(present), messages[np.asarray(present)]
        return _OutputRows(values, messages, dropped)

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


def _dropped(parts: Sequence[_OutputRows], index: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """Return the messages without a row in any output, by rule: `drop_when` of an output, or only empty lists."""
    empty = np.ones(len(index), bool)
    by_condition = np.zeros(len(index), bool)
    for part in parts:
        empty[part.messages] = False
        by_condition |= part.dropped
    masks = {"drop_when": empty & by_condition, "rows": empty & ~by_condition}
    return {rule: index[mask] for rule, mask in masks.items() if mask.any()}


@dataclass(frozen=True, slots=True)
class MappingSpec:
    """A valid adapter file; implements `AdapterSpec`. It can be pickled if its adapter lookup can."""

    model: MappingFile
    origin: Source | Path
    """The file's text with the locations of its values, or the path to read them from."""
    ontology: OntologyType
    adapters: AdapterLookup | None = None
    """Finds the adapters that `use` names."""
    output: str = ""
    """The name of the output that the adapter makes; empty for the file as a whole, which binds to its first output."""
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
        """The adapter's name, such as `IMUAdapter`, with the name of the output if it stands for one of several."""
        return f"{self.model.adapter}.{self.output}" if self.output else self.model.adapter

    @property
    def outputs(self) -> tuple[MappingSpec, ...]:
        """One spec for each output of the file; () if the file has no `outputs`."""
        if self.output or self.model.outputs is None:
            return ()
        return tuple(
            MappingSpec(self.model, self.origin, _known_ontology(record), self.adapters, name)
            for name, record in records_of(self.model).items()
        )

    def inverse_finding(self, adapter: MappingAdapter) -> Finding | None:
        """Return why an adapter that is bound to a definition has no inverse, located at `rows` or `outputs`."""
        if adapter.inverse_problem is None:
            return None
        output = self.output or next(iter(records_of(self.model)))
        outputs = () if self.model.outputs is None else ("outputs", output)
        span = self.source.key_span((*outputs, "rows") if adapter.levels else ("outputs",))
        return Finding("no-inverse", Severity.WARNING, adapter.inverse_problem, span)

    def with_parameters(self, values: Mapping[str, Scalar]) -> MappingSpec:
        """Return the adapter with other values of its parameters.

        Raises:
            AdapterError: There is no such parameter, or a value has another type than the default.
        """
        for name, value in values.items():
            problem, hint = parameter_problem(self.model.parameters, name, value)
            if problem is not None:
                raise AdapterError(f"{self.model.adapter}: {problem}", hint=hint)
        model = self.model.model_copy(update={"parameters": {**self.model.parameters, **values}})
        return MappingSpec(model, self.origin, self.ontology, self.adapters, self.output)

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
        return MappingSpec, (self.model, self.origin, self.ontology, self.adapters, self.output)

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
        parameters = {
            name: Binding(typed_constant(value, name), 0) for name, value in self.model.parameters.items()
        }
        scope = Scope(
            ExprType(shape, msgtype=definition.root), definition.types, parameters, has_envelope=True
        )
        adapters: dict[str, MappingAdapter] = {}
        records = records_of(self.model)
        own_name = self.output or next(iter(records))
        for name, record in records.items():
            ontology = self.ontology if name == own_name else _known_ontology(record)
            compiled = compiler.record(self.model, record, ontology, scope, variant)
            metadata = compiler.metadata(record, replace(scope, has_envelope=False))
            if compiled is not None:
                adapters[name] = MappingAdapter(
                    ontology, compiled.plan, metadata, definition.root, compiled.drops, compiled.levels
                )
        own = adapters.pop(own_name, None)
        if own is None or analyzer.findings:
            return None, tuple(analyzer.findings)
        return replace(own, others=tuple(adapters.values())), ()


def parameter_problem(
    defaults: Mapping[str, object], name: str, value: object
) -> tuple[str | None, str | None]:
    """Return the problem of a value for one of an adapter's parameters with its hint; None if it is valid."""
    if name not in defaults:
        hint = suggest(name, defaults) or f"its parameters are: {', '.join(defaults) or 'none'}"
        return f"there is no parameter {name!r}", hint
    default = defaults[name]
    fits = default is None or type(value) is type(default)
    if fits or (isinstance(default, float) and type(value) is int):
        return None, None
    return (
        f"the parameter {name!r} is {value!r}, its default is {default!r}",
        "write a value of the same type",
    )


def _known_ontology(record: RecordModel) -> OntologyType:
    """Return the ontology type of an output that was checked when its file was loaded."""
    if isinstance(record.ontology, InlineType):
        return inline_ontology_type(record.ontology, Analyzer(_no_source), record.path)
    return ontology_type(str(record.ontology))


def _no_source() -> Source:
    raise AssertionError


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
    _check_keys(model, analyzer)
    records = records_of(model)
    ontologies = {name: _ontology(record, analyzer) for name, record in records.items()}
    compiler = Compiler(analyzer, None, adapters)
    for name, record in records.items():
        ontology = ontologies[name]
        if ontology is not None:
            compiler.record(model, record, ontology, None, None)
            compiler.metadata(record, None)
    ontology = next(iter(ontologies.values()))
    if ontology is None or None in ontologies.values():
        return None, tuple(analyzer.findings)
    return MappingSpec(model, source, ontology, adapters), tuple(analyzer.findings)


def _check_keys(model: MappingFile, analyzer: Analyzer) -> None:
    """Report keys that are missing or exclude each other, and names that cannot be bound."""
    keys = model.model_fields_set
    single = ("ontology", "fields", "rows", "schema_metadata")
    if model.outputs is None:
        for key, value in (("ontology", model.ontology), ("fields", model.fields)):
            if value is None:
                message = f"the adapter needs the key {key!r}"
                analyzer.report(("adapter",), message, f"add {key}:, or outputs:", rule="missing-key")
        return _check_names(model, analyzer)
    for key in single:
        if key in keys:
            message = f"{key!r} and 'outputs' exclude each other"
            analyzer.report((key,), message, f"move {key} into each output", rule="conflicting-keys")
    for name, wrapper in (model.variants or {}).items():
        for key in wrapper.keys() - {"of"}:
            message = "the variants of an adapter with outputs can only have the key 'of'"
            analyzer.report(
                ("variants", name, key), message, "move the column into an output", rule="field-form"
            )
    return _check_names(model, analyzer)


def _check_names(model: MappingFile, analyzer: Analyzer) -> None:
    for section, names in (("parameters", model.parameters), ("let", model.let)):
        for name in names:
            if name in RESERVED_NAMES or keyword.iskeyword(name):
                message = f"{name!r} has another meaning in expressions"
                analyzer.report((section, name), message, "choose another name")
            elif section == "let" and name in model.parameters:
                analyzer.report((section, name), f"{name!r} is a parameter", "choose another name")


def _ontology(record: RecordModel, analyzer: Analyzer) -> OntologyType | None:
    if record.ontology is None:
        return None
    if isinstance(record.ontology, InlineType):
        return inline_ontology_type(record.ontology, analyzer, record.path)
    try:
        return ontology_type(record.ontology)
    except UnknownTag as error:
        path = (*record.path, "ontology")
        analyzer.report_value(path, error.what, error.hint, rule="unknown-ontology")
        return None


def _adapter_error(message: str, source: Source, findings: tuple[Finding, ...]) -> AdapterError:
    """Return the error for findings: its text shows the first one."""
    first = findings[0] if findings else None
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    text = f"{message}: {first.message}{more}" if first else message
    location = str(first.span) if first and first.span else source.file
    return AdapterError(text, where=location, hint=first.help if first else None, findings=findings)


def inline_ontology_type(inline: InlineType, analyzer: Analyzer, base: KeyPath = ()) -> OntologyType:
    """Return the ontology type declared below the key path `base`; fields with a finding are omitted."""
    path: KeyPath = (*base, "ontology", "fields")
    if _ENVELOPE_COLUMN in inline.fields:
        message = f"{_ENVELOPE_COLUMN} is the column of the log time"
        analyzer.report((*path, _ENVELOPE_COLUMN), message, "rename the field")
    if inline.tag in MODULES:
        message = f"{inline.tag!r} is a built-in tag with its own columns"
        hint = f"write ontology: {inline.tag}, or choose another tag"
        analyzer.report_value((*base, "ontology", "tag"), message, hint)
    return OntologyType(inline.tag, pa.struct(_fields(inline.fields, path, analyzer)), inline.format)


def _fields(fields: Mapping[str, FieldType], path: KeyPath, analyzer: Analyzer) -> list[DataType]:
    columns = (_field(name, field, (*path, name), analyzer) for name, field in fields.items())
    return [column for column in columns if column is not None]


def _field(name: str, field: FieldType, path: KeyPath, analyzer: Analyzer) -> DataType | None:
    if not name.isidentifier():  # Queries and SQL separate nested fields with dots.
        analyzer.report(path, f"{name!r} is not a valid field name", "use letters, digits and _")
        return None
    declaration = FieldDeclaration(type=field) if isinstance(field, str) else field
    type_: DataType | None
    if declaration.fields is not None and declaration.type in {None, _LIST_OF_STRUCTS}:
        struct = pa.struct(_fields(declaration.fields, (*path, "fields"), analyzer))
        type_ = struct if declaration.type is None else arrays.list_(struct)
    elif declaration.type is None or declaration.fields is not None:
        hint = "write {type: float64}, {fields: {…}}, or {type: list, fields: {…}}"
        analyzer.report(path, f"the field {name!r} needs either type or fields", hint)
        return None
    else:
        type_path = path if isinstance(field, str) else (*path, "type")
        type_ = _type(declaration.type, type_path, analyzer)
    return None if type_ is None else pa.field(name, type_, nullable=declaration.nullable)


def _type(text: str, path: KeyPath, analyzer: Analyzer) -> DataType | None:
    text = text.strip()
    if text in PLAIN_TYPES:
        return PLAIN_TYPES[text]
    match = _LIST.fullmatch(text)
    if match is not None:
        element = _type(match["element"], path, analyzer)
        if element is None:
            return None
        return arrays.list_(element, int(match["size"])) if match["size"] else arrays.list_(element)
    try:
        return ontology_type(text).struct
    except UnknownTag as error:
        nearest = suggest(text, PLAIN_TYPES) or error.hint
        types = f"use {', '.join(PLAIN_TYPES)}, list[T], list[T, N] or an ontology tag"
        hint = f"{nearest} {types}" if nearest and nearest.startswith("did you mean") else types
        analyzer.report_value(path, f"{text!r} is neither a type nor an ontology tag", hint)
        return None


def unread_paths(shape: DataType, reads: set[ReadPath], at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields of a message that are not among the fields read; a struct of unread fields is one each."""
    for each in shape:
        path = (*at, each.name)
        if any(path[:length] in reads for length in range(len(path) + 1)):
            continue
        element = each.type
        while is_list(element):
            element = element.value_type
        if pt.is_struct(element) and any(path_read[: len(path)] == path for path_read in reads):
            yield from unread_paths(element, reads, path)
        else:
            yield path


def column_reads(adapter: MappingAdapter, at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields that the columns and the conditions of an adapter read, as paths from the message."""
    for output in (adapter, *adapter.others):
        yield from _of_field(output.record, (at,))
        for typed in output.drops:
            yield from _of_value(typed, (at,))


def metadata_reads(adapter: MappingAdapter, at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields that the topic metadata contains."""
    for output in (adapter, *adapter.others):
        for typed in output.metadata.values():
            yield from _of_value(typed, (at,))


def _of_field(field: ColumnPlan, at: _Scopes) -> Iterator[ReadPath]:
    """Yield the fields that a column reads, as paths from the message; `at` is the scope of its names."""
    source = field.source
    match source:
        case ExpressionSource():
            yield from _of_value(source.expression, at)
        case MapLookup():
            yield from _of_value(source.operand, at)
            if source.otherwise is not None:
                yield from _of_value(source.otherwise, at)
        case NestedAdapter():
            inner = source.adapter
            path = _path_of(source.operand, at)
            yield from column_reads(inner, path) if isinstance(inner, MappingAdapter) else (path,)
        case StructSource():
            inside = at if source.operand is None else (*at, _path_of(source.operand, at))
            if source.operand is not None:
                yield from _computed_inside(source.operand, at)
            for column in source.fields:
                yield from _of_field(column, inside)
        case _:
            pass
    for column in field.overrides:
        yield from _of_field(column, at)
    if field.when is not None:
        yield from _of_value(field.when, at)


def _of_value(typed: TypedExpression, at: _Scopes) -> Iterator[ReadPath]:
    match typed:
        case Constant() | EnvelopeField():
            return
        case OuterValue():
            yield from _of_value(typed.operand, at[: -typed.levels])
            return
        case FunctionCall(arguments=parts) | MakeList(items=parts):
            pass
        case Conditional():
            parts = (typed.condition, typed.then, typed.otherwise)
        case Cast():
            parts = (typed.operand,)
        case _:
            yield _path_of(typed, at)
            yield from _computed_inside(typed, at)
            return
    for part in parts:
        yield from _of_value(part, at)


def _computed_inside(typed: TypedExpression, at: _Scopes) -> Iterator[ReadPath]:
    """Yield the fields below a computed list, as in `sort(a)[0]`."""
    inner: Any = typed
    while isinstance(inner, (FieldAccess, OpenList, CloseList, ElementAt)):
        inner = inner.operand
    if not isinstance(inner, MessageRef):
        yield from _of_value(inner, at)


def _path_of(typed: TypedExpression, at: _Scopes) -> ReadPath:
    """Return the path of the field that an expression reads; computed values have the path of no field."""
    match typed:
        case FieldAccess():
            return (*_path_of(typed.operand, at), typed.name)
        case OpenList() | CloseList() | ElementAt():
            return _path_of(typed.operand, at)
        case MessageRef():
            return at[-1]
        case OuterValue():
            return _path_of(typed.operand, at[: -typed.levels])
        case _:
            return ("",)  # no field has an empty name
