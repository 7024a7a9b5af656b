"""Annotations of manifest fields, functions that find and change annotated fields, and the types that sections share.

`extends`, lint, the removal of secrets, shipping to a cluster, JSON Schema and docs/manifest.md are derived from these
annotations, so a new key needs no entry in a list.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import cache
from typing import Annotated, Any, Literal, TypeAlias, get_args, get_origin

from msgspec import Struct
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    StringConstraints,
    Tag,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema
from typing_extensions import Self

from mosaico_ingest.job.values import Limit, TimeBound, format_time, parse_limit, parse_time

PathPattern: TypeAlias = tuple["str | None", ...]
"""A key path in which `ANY` stands for every key of a mapping or position in a list."""
ANY = None
_MAX_COUNT = 1_000_000_000
ParameterValue = bool | int | float | str | None
ImageFormat = Literal["raw", "png", "jpeg", "buffer_png"]
"""The formats of stored images."""
_FORMATS = {"quality": ("jpeg",), "max_width": ("png", "jpeg"), "depth_unit": ("png",)}
"""The formats that each key affects."""


class PathRole(Enum):
    """How a job uses a file or folder."""

    RECORDING = "recording"
    BASE = "base"
    """Another manifest."""
    INPUT = "input"
    """A file that is read when the job is loaded, by the machine that has the manifest."""
    WORKER_FILE = "worker file"
    """A file that is read by the machine that ingests the recording."""
    DEFINITIONS = "definitions"
    """A `.msg` file or a folder of them, read by the machine that ingests the recording."""
    SCHEMA = "schema"
    """A JSON Schema, read with the files that it refers to by the machine that ingests the recording."""
    STORE = "store"
    OUTPUT_FILE = "output file"
    OUTPUT_FOLDER = "output folder"

    @property
    def accepts_urls(self) -> bool:
        """Whether the path can be a URL."""
        return self in {PathRole.RECORDING, PathRole.STORE}


class FilePath(Struct, frozen=True):
    """The text is a path; relative paths start at the manifest's folder."""

    role: PathRole


class AdapterRef(Struct, frozen=True):
    """The text is the name of an adapter, `module:Class`, `file.py:Class` or the path of a YAML file."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 - a type
        """Accept text in manifests; in Python, also accept classes and specs."""
        del source, handler
        return core_schema.json_or_python_schema(
            json_schema=core_schema.str_schema(min_length=1, strict=True),
            python_schema=core_schema.any_schema(),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Describe the text."""
        del schema, handler
        return {"type": "string", "minLength": 1}


class TopicGlob(Struct, frozen=True):
    """The text is a topic name or glob."""

    excludes: bool = False
    """Whether a leading `!` excludes topics."""
    default: str | None = None
    """The key that is not a topic and applies to topics that no other key matches."""


class Secret(Struct, frozen=True):
    """The text must not be shown."""


class Literally(Struct, frozen=True):
    """The value is used as written: `${NAME}` in it is not a variable."""


class Parsed(Struct, frozen=True):
    """A value that manifests write as text in a special notation, such as `512MiB`."""

    parse: Callable[[str], Any]
    """Returns the value; raises ValueError."""
    pattern: str
    """The regular expression for JSON Schema; it may accept more than `parse`."""
    whole_numbers: bool = False
    """Whether a manifest may write a whole number without quotes."""
    to_json: Callable[[Any], Any] = str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 - a type
        """Accept the notation in manifests; in Python, also accept the value."""
        del handler
        text: CoreSchema = core_schema.str_schema(min_length=1, strict=True)
        if self.whole_numbers:
            text = core_schema.no_info_before_validator_function(_number_as_text, text)
        text = core_schema.no_info_after_validator_function(self.parse, text)
        value = core_schema.is_instance_schema(source)
        return core_schema.json_or_python_schema(
            json_schema=text,
            python_schema=core_schema.union_schema([value, text]),
            serialization=core_schema.plain_serializer_function_ser_schema(self.to_json),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Describe the notation."""
        del schema, handler
        if self.whole_numbers:
            return {"type": ["string", "integer"], "minLength": 1, "minimum": 0, "pattern": self.pattern}
        return {"type": "string", "minLength": 1, "pattern": self.pattern}


def _number_as_text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class MarkedField(Struct, frozen=True):
    """A key path in a model whose annotation has a marker."""

    path: PathPattern
    marker: Any
    is_key: bool = False
    """True if the marker applies to the keys of the mapping at `path` instead of the value."""


@cache
def marked_fields(model: type[BaseModel], kind: type[Any]) -> tuple[MarkedField, ...]:
    """Return the fields of a model and of the models inside it whose annotations have a marker of this kind."""
    fields: dict[MarkedField, None] = {}
    for name, field in model.model_fields.items():
        fields.update(dict.fromkeys(_marked(field.annotation, tuple(field.metadata), (name,), kind)))
    return tuple(fields)


def _marked(
    annotation: Any,  # noqa: ANN401 - a type
    metadata: tuple[Any, ...],
    path: PathPattern,
    kind: type[Any],
) -> Iterator[MarkedField]:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _marked(arguments[0], (*metadata, *arguments[1:]), path, kind)
        return
    yield from (MarkedField(path, marker) for marker in metadata if isinstance(marker, kind))
    if origin is tuple:
        yield from _marked(arguments[0], (), (*path, ANY), kind)
    elif origin is dict:
        key, value = arguments
        for field in _marked(key, (), path, kind):
            yield MarkedField(path, field.marker, is_key=True)
        yield from _marked(value, (), (*path, ANY), kind)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for field in marked_fields(annotation, kind):
            yield MarkedField((*path, *field.path), field.marker, field.is_key)
    else:
        for argument in arguments:
            yield from _marked(argument, (), path, kind)


def matches(path: tuple[object, ...], pattern: PathPattern) -> bool:
    """Return whether a key path has the form of a pattern."""
    return len(path) == len(pattern) and all(
        part in (ANY, key) for part, key in zip(pattern, path, strict=True)
    )


def values_at(value: object, pattern: PathPattern) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield the values of a model or document whose key path has the form of a pattern, each with its key path."""
    if not pattern:
        yield (), value
        return
    for key, child in _children(value, pattern[0]):
        for path, inner in values_at(child, pattern[1:]):
            yield (key, *path), inner


def _children(value: object, part: str | None) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, BaseModel):
        if part is not None and part in type(value).model_fields:
            yield part, getattr(value, part)
    elif isinstance(value, Mapping):
        yield from ((key, child) for key, child in value.items() if part in (ANY, key))
    elif isinstance(value, list | tuple) and part is ANY:
        yield from enumerate(value)


def replace_values(
    value: Any,  # noqa: ANN401 - any model or document
    pattern: PathPattern,
    change: Callable[[tuple[Any, ...], str], Any],
    path: tuple[Any, ...] = (),
) -> Any:  # noqa: ANN401 - as `value`
    """Return a model or document with `change(key path, text)` for each text at a pattern; `value` is not modified."""
    if not pattern:
        return change(path, value) if isinstance(value, str) else value
    children = dict(_children(value, pattern[0]))
    new_children = {
        key: replace_values(child, pattern[1:], change, (*path, key)) for key, child in children.items()
    }
    if all(new_children[key] is child for key, child in children.items()):
        return value
    if isinstance(value, BaseModel):
        return value.model_copy(update=new_children)
    if isinstance(value, Mapping):
        return {**value, **new_children}
    return type(value)(new_children.values())


def shape_of(value: Any) -> str:  # noqa: ANN401 - any YAML value
    """Return the tag of a value in a union: `several` for a list or mapping, otherwise `one`."""
    return "several" if isinstance(value, list | tuple | dict) else "one"


def _limit_to_json(limit: Limit) -> int | float | None:
    return limit.count if limit.share is None else limit.share


Text = Annotated[str, StringConstraints(min_length=1)]
Count = Annotated[int, Field(ge=1, le=_MAX_COUNT)]
Time = Annotated[
    TimeBound,
    Parsed(
        parse_time, r"^([+-][0-9.]+ ?(ns|us|ms|s|min|h)|[0-9]{4}-[0-9]{2}-[0-9]{2}.*)$", to_json=format_time
    ),
]
MessageLimit = Annotated[
    Limit,
    Parsed(
        parse_limit,
        r"^[0-9]+$|^0*(100(\.0*)?|[0-9]{1,2}(\.[0-9]+)?) ?%$",
        whole_numbers=True,
        to_json=_limit_to_json,
    ),
]
Topic = Annotated[Text, TopicGlob()]


class Section(BaseModel):
    """A section of a manifest: a mapping with defined keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    def replace(self, **changes: Any) -> Self:  # noqa: ANN401 - the types of the fields
        """Return a copy with other values, which are not validated."""
        return self.model_copy(update=changes)


AdapterReference = Annotated[Any, AdapterRef()]
"""An adapter: in manifests a text, in Python also a class or an `AdapterSpec`."""


class ParameterizedAdapter(Section):
    """An adapter file with values of its parameters."""

    file: AdapterReference
    """The path of the adapter file."""
    values: dict[Text, ParameterValue] = Field(alias="with", examples=[{"cells": 12}])
    """Parameter → value; parameters that are not listed have the default that the file declares."""

    def __str__(self) -> str:
        """Return the path of the file."""
        return str(self.file)


LoadedAdapter = Annotated[
    Annotated[AdapterReference, Tag("one")] | Annotated[ParameterizedAdapter, Tag("several")],
    Discriminator(shape_of),
]
"""An adapter, with or without values of its parameters."""


def reference_of(adapter: object) -> Any:  # noqa: ANN401 - what `AdapterReference` accepts
    """Return the reference of an entry in `adapters.load`."""
    return adapter.file if isinstance(adapter, ParameterizedAdapter) else adapter


class ImageSettings(Section):
    """The format of stored raw images. Compressed images and video keep their bytes."""

    format: ImageFormat = "raw"
    """The format: `raw` (as recorded), `png` (a lossless picture), `jpeg`, or `buffer_png` (the bytes of the image as a gray PNG,
    for every encoding, as the official bridge stores them)."""
    quality: Annotated[int, Field(ge=1, le=100)] = 90
    """The quality of JPEG files, from 1 to 100."""
    max_width: Count | None = Field(default=None, examples=[1280])
    """The maximum width in pixels; wider images are scaled down and keep their proportions."""
    depth_unit: Annotated[float, Field(gt=0, le=1)] = 0.001
    """The step in meters at which `png` stores depth images of floating-point numbers in 16 bits."""

    def used(self) -> dict[str, Any]:
        """Return the settings that are set and that affect the format."""
        values = {key: getattr(self, key) for key, formats in _FORMATS.items() if self.format in formats}
        return {"format": self.format, **{key: value for key, value in values.items() if value is not None}}

    @model_validator(mode="after")
    def _check_format(self) -> ImageSettings:
        for key, formats in _FORMATS.items():
            if key in self.model_fields_set and self.format not in formats:
                names = " or ".join(formats)
                message = f"{key} requires format: {names}, but format is {self.format}"
                raise PydanticCustomError("conflicting-keys", "{message}", {"key": key, "message": message})
        return self


def image_settings(value: ImageSettings | ImageFormat) -> ImageSettings:
    """Return the settings of `topic_settings.<topic>.image`, which may be only a format."""
    return ImageSettings(format=value) if isinstance(value, str) else value
