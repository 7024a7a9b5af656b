"""Text files, JSON documents with their schemas, and tables for notebooks.

Pydantic's `use_attribute_docstrings` would read the source of every class at each import; here only the schema reads it.
"""

from __future__ import annotations

import ast
import errno
import inspect
import json
import os
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from html import escape
from itertools import islice, pairwise
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from textwrap import indent
from threading import Lock
from typing import IO, TYPE_CHECKING, Any, Literal, TypeVar, cast
from weakref import finalize

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, core_schema
from pydantic_core.core_schema import ModelSchema
from typing_extensions import Self

from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.findings import escape_undecodable
from mosaico_ingest.remote import AnyPath

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

MAX_FILE_BYTES = 64 * 1024 * 1024
"""Maximum size of a manifest, definition, plan or report that is read, in bytes."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_MAX_MESSAGE = 200
"""Maximum length of a schema violation in an error message, as it repeats the value."""
_Model = TypeVar("_Model", bound=BaseModel)
MAX_ROWS = 100
"""Rows of a table; the last line states how many there are."""


def read_limited(path: AnyPath) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: The file cannot be read, is a pipe or a device (which could block), or is larger than `MAX_FILE_BYTES`.
    """
    mode = path.stat().st_mode
    if not S_ISREG(mode) and not S_ISDIR(mode):
        raise OSError(errno.EINVAL, "a pipe, a socket or a device, not a file", str(path))
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise OSError(errno.EFBIG, f"longer than {MAX_FILE_BYTES >> 20} MiB", str(path))
    return content


def check_output_file(path: Path) -> None:
    """Raise if a path cannot be an output file, before there is output.

    Raises:
        ManifestError: The path is a folder.
    """
    if path.is_dir():
        raise ManifestError("is a folder", where=str(path), hint="name a file")


def write_atomically(path: Path, text: str | Iterable[str]) -> None:
    """Write a text file and create its folder; an existing file stays until the new one is complete.

    The text may come in parts, which are written one after the other.

    Raises:
        ManifestError: The path is a folder.
        SinkError: The file cannot be written.
    """
    with AtomicFile(path) as file:
        for part in [text] if isinstance(text, str) else text:
            file.write(part)


class AtomicFile:
    """A text file that is written in parts; an existing file stays until the block ends without an error.

    Raises:
        ManifestError: The path is a folder.
        SinkError: The file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        check_output_file(path)
        self._path = path
        self._partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
        with self._translated_errors():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._partial.open("w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is not None:
            with suppress(OSError):
                self._file.close()
            self._partial.unlink(missing_ok=True)
            return
        with self._translated_errors():
            self._file.close()
            self._partial.replace(self._path)

    def write(self, text: str) -> None:
        """Append text."""
        with self._translated_errors():
            self._file.write(text)

    @contextmanager
    def _translated_errors(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            with suppress(OSError):
                self._partial.unlink()
            raise SinkError(f"cannot be written: {error.strerror}", where=str(self._path)) from error


class JsonListWriter:
    """Writes a JSON document item by item: `text` with two spaces of indent, whose last empty list gets the items.

    Nothing is written before the first item or the end.
    """

    def __init__(self, write: Callable[[str], object], text: str) -> None:
        self._write = write
        self._start, _, self._end = text.rpartition("]")
        last_line = self._start.rpartition("\n")[2]
        self._indent = last_line[: len(last_line) - len(last_line.lstrip())]
        self.has_items = False

    def add(self, item: str) -> None:
        """Write an item, the text of a JSON value with two spaces of indent."""
        self._write(f"{',' if self.has_items else self._start}\n{indent(item, f'{self._indent}  ')}")
        self.has_items = True

    def finish(self) -> None:
        """Write the end of the document."""
        self._write(f"\n{self._indent}]{self._end}\n" if self.has_items else f"{self._start}]{self._end}\n")


class LineFile:
    """The lines of a file by their offsets; the file stays open as long as the object is used."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock()
        self._file: IO[bytes] | None = None

    def read(self, offset: int) -> bytes:
        """Return the line at an offset.

        Raises:
            ManifestError: The file cannot be read.
        """
        try:
            with self._lock:
                if self._file is None:
                    self._file = self.path.open("rb")
                    finalize(self, self._file.close)
                self._file.seek(offset)
                return self._file.readline()
        except OSError as error:
            raise ManifestError(f"cannot be read: {error.strerror}", where=str(self.path)) from error


def schema_of(
    model: type[BaseModel], *, mode: Literal["validation", "serialization"] = "validation"
) -> dict[str, Any]:
    """Return the JSON Schema of `model`; fields are named as files name them."""
    return model.model_json_schema(mode=mode, schema_generator=_WithDocstrings)


def document_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the published JSON Schema of files that hold `model`; computed fields are optional."""
    schema = schema_of(model, mode="serialization")
    for part in (schema, *schema.get("$defs", {}).values()):
        computed = {name for name, member in part.get("properties", {}).items() if member.get("readOnly")}
        if computed:
            part["required"] = [name for name in part["required"] if name not in computed]
    return {"$schema": DIALECT, **schema}


def read_document(content: bytes, model: type[_Model], *, where: str, kind: str, hint: str) -> _Model:
    """Validate a JSON file against the published schema of `model` and return the model.

    Raises:
        ManifestError: The content is not JSON, or violates the schema; the message has the JSON path and the keyword.
    """
    from jsonschema.exceptions import best_match  # noqa: PLC0415 - slow to import, and only needed to read plans and reports

    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"is not {kind}: not JSON: {error}", where=where, hint=hint) from error
    violation = best_match(_validator(model).iter_errors(document))
    if violation is not None:
        message = violation.message[:_MAX_MESSAGE]
        raise ManifestError(
            f"is not {kind}: {violation.json_path}: {message} ({violation.validator})", where=where, hint=hint
        )
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        raise ManifestError(
            f"is not {kind}: ${path}: {first['msg']} ({first['type']})", where=where, hint=hint
        ) from error


@cache
def _validator(model: type[BaseModel]) -> Validator:
    import jsonschema  # noqa: PLC0415 - as in `read_document`

    return jsonschema.Draft202012Validator(document_schema(model))


class _WithDocstrings(GenerateJsonSchema):
    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Add the docstrings of a model's fields as descriptions."""
        result, model = super().model_schema(schema), schema["cls"]
        model.model_rebuild()  # resolves aliases of classes that are defined later
        members = result.get("properties", {})
        for owner in reversed(model.__mro__):
            if not issubclass(owner, BaseModel) or owner is BaseModel:
                continue
            for name, text in _docstrings(owner).items():
                field = model.model_fields.get(name)
                member = members.get((field and field.alias) or name)
                if member is not None:
                    member.setdefault("description", text)
        return result


def _docstrings(owner: type) -> dict[str, str]:
    """Return the string under each annotated name of a class body."""
    tree = ast.parse(inspect.cleandoc("\n" + inspect.getsource(owner)))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    return {
        above.target.id: inspect.cleandoc(below.value.value)
        for above, below in pairwise(body)
        if isinstance(above, ast.AnnAssign) and isinstance(above.target, ast.Name)
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(below.value.value, str)
    }


def tidy(node: dict[str, Any]) -> dict[str, Any]:
    """Remove titles, which repeat the keys, null as the default of optional keys, and the defaults of sections."""
    branches = [branch for branch in node.get("anyOf", ()) if branch != {"type": "null"}]
    if len(branches) == 1:
        node = {**{key: value for key, value in node.items() if key != "anyOf"}, **branches[0]}
    noise = {"title", "default"} if "$ref" in node and isinstance(node.get("default"), dict) else {"title"}
    members = {
        key: value for key, value in node.items() if key not in noise and (key, value) != ("default", None)
    }
    return {key: _tidy_member(key, value) for key, value in members.items()}


def _tidy_member(key: str, value: object) -> object:
    if key in {"default", "examples"}:
        return value
    if key == "description":
        return " ".join(str(value).split())
    if key in {"properties", "$defs"}:
        members = cast("dict[str, dict[str, Any]]", value)  # names, not keywords
        return {name: tidy(member) for name, member in members.items()}
    if isinstance(value, dict):
        return tidy(cast("dict[str, Any]", value))
    if isinstance(value, list):
        return [tidy(cast("dict[str, Any]", item)) if isinstance(item, dict) else item for item in value]
    return value


class Unchecked:
    """Marks a field whose values are not validated: objects of the program that a document describes."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 - a type
        """Accept every value."""
        del source, handler
        return core_schema.any_schema()


class Part(BaseModel):
    """A model whose texts can be encoded, whatever the names of files hold."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    def replace(self, **changes: Any) -> Self:  # noqa: ANN401 - the types of the fields
        """Return a copy with other values, which are not validated."""
        return self.model_copy(update=changes)

    @model_validator(mode="before")
    @classmethod
    def _spell_texts(cls, values: Any) -> Any:  # noqa: ANN401 - whatever stands for a part
        """Escape undecodable file names in all fields; one validator per field would make the models slow to build."""
        return (
            {name: _encodable(value) for name, value in values.items()}
            if isinstance(values, dict)
            else values
        )


def _encodable(value: Any) -> Any:  # noqa: ANN401 - every field of every part
    if type(value) is str:
        return escape_undecodable(value)
    if isinstance(value, tuple):
        return tuple(escape_undecodable(item) if type(item) is str else item for item in value)
    return value


def html_table(
    caption: str,
    names: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    count: int,
    numbers: Collection[str] = (),
    notes: Sequence[str] = (),
) -> str:
    """Return a table of escaped text with at most `MAX_ROWS` of `count` rows; columns in `numbers` are right-aligned."""
    aligned = [
        " style='text-align:right'" if name in numbers else " style='text-align:left'" for name in names
    ]
    head = "".join(f"<th{style}>{escape(name)}</th>" for name, style in zip(names, aligned, strict=True))
    body = "".join(
        "<tr>"
        + "".join(f"<td{style}>{escape(cell)}</td>" for cell, style in zip(row, aligned, strict=True))
        + "</tr>"
        for row in islice(rows, MAX_ROWS)
    )
    more = [f"… and {count - MAX_ROWS:,} more"] if count > MAX_ROWS else []
    lines = "".join(f"<p>{escape(line)}</p>" for line in (*more, *notes))
    title = f"<caption style='text-align:left'><b>{escape(caption)}</b></caption>"
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{lines}"
