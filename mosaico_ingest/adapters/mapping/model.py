"""The model of an adapter file, and its JSON Schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Struct
from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from mosaico_ingest.documents import DIALECT, schema_of, tidy
from mosaico_ingest.ontology.registry import SerializationFormat


def _plain(value: object) -> object:
    """Reject values that are not plain, with one error instead of one per type of the union."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise PydanticCustomError("plain_value", "it must be an expression, a number, true, false or null")


Scalar: TypeAlias = Annotated[bool | int | float | str | None, BeforeValidator(_plain)]
TypeName: TypeAlias = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z]\w*(/(msg/)?[A-Za-z]\w*|(\.[A-Za-z_]\w*)*)$",
        examples=["sensor_msgs/msg/Imu", "foxglove.PoseInFrame"],
    ),
]
_NAME = r"^[A-Za-z_]\w*$"
Identifier: TypeAlias = Annotated[str, Field(pattern=_NAME)]
OutputName: TypeAlias = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*(/[A-Za-z_]\w*)*$", examples=["battery"])]


class _Strict(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, populate_by_name=False, defer_build=True
    )


def _form_or_scalar(value: object) -> str:
    return "form" if isinstance(value, (Mapping, BaseModel)) else "scalar"


def _one_or_many(value: object) -> str:
    return "many" if isinstance(value, Sequence) and not isinstance(value, str) else "one"


def _type_or_text(value: object) -> str:
    return "inline" if isinstance(value, (Mapping, BaseModel)) else "text"


class ValueForm(_Strict):
    """A value that needs more than an expression; exactly one of `value`, `use` and `fields` is its source."""

    value: Scalar = None
    """An expression."""
    map: Annotated[Mapping[Scalar, Scalar], Field(min_length=1)] | None = None
    """Replacements for `value`: keys are values, or names of constants of the message. Text in a replacement is an
    expression that is the same for every row, such as a constant or `'idle'`."""
    otherwise: Annotated[
        Scalar, Field(alias="else", default="error", examples=["error", "keep", "'unknown'"])
    ]
    """The result for a value that is not in `map`: `error` rejects the row, `keep` keeps the value, text is an expression."""
    use: str | None = None
    """The adapter that converts the nested message `of`."""
    of: str | None = None
    """An expression for the nested message (`a.b`), or for the messages of a list (`a[]`)."""
    fields: Mapping[str, Value] | None = None
    """Field of the struct → value; names are looked up in `of` if it is given."""
    replaced: Annotated[Mapping[str, Value] | None, Field(alias="with")] = None
    """Fields of the resulting struct with another source; names are looked up outside `of`."""
    when: str | None = None
    """A condition; the value is null in rows where it is not true."""


Value: TypeAlias = Annotated[
    Annotated[Scalar, Tag("scalar")] | Annotated[ValueForm, Tag("form")], Discriminator(_form_or_scalar)
]
"""Text is an expression; numbers, `true`, `false` and `null` are literals; a mapping is a `ValueForm`."""


class FieldDeclaration(_Strict):
    """A field of a declared ontology type."""

    type: str | None = None
    """`float32`, `list[float64]`, `list[float64, 9]`, or an ontology tag."""
    fields: Mapping[str, FieldType] | None = None
    """The fields of a nested struct; with `type: list`, the fields of each struct in a list."""
    nullable: bool = True
    """Whether rows may lack a value."""
    unit: str | None = None
    """The unit, such as `m/s`; documentation only."""
    description: str | None = None
    """Documentation only."""


FieldType: TypeAlias = Annotated[
    Annotated[str, Tag("text")] | Annotated[FieldDeclaration, Tag("inline")], Discriminator(_type_or_text)
]


class InlineType(_Strict):
    """An ontology type that the file declares."""

    tag: Annotated[str, Field(pattern=_NAME, examples=["WheelTicks"])]
    """The name of the type, by which readers find it."""
    format: Annotated[SerializationFormat, Field(strict=False)] = SerializationFormat.DEFAULT
    """The serialization format on the platform."""
    fields: Annotated[Mapping[str, FieldType], Field(min_length=1)]
    """Column → type."""


class RecordedMessage(_Strict):
    """A reference to a recorded message."""

    bag: str
    """The path of a recording, relative to the adapter file."""
    topic: str
    """The topic."""
    index: Annotated[int, Field(ge=0)] = 0
    """The position of the message within its topic, from 0."""


class MessageProperties(_Strict):
    """The properties of a message besides its content."""

    log_time: int = 0
    """Log time in ns since the epoch."""
    publish_time: int | None = None
    """Publish time in ns since the epoch; by default the log time."""
    topic: str = ""
    """The topic."""
    sequence: Annotated[int, Field(ge=0)] = 0
    """The sequence number."""


Expected: TypeAlias = Annotated[
    Annotated[Mapping[str, Any], Tag("one")] | Annotated[Sequence[Mapping[str, Any]], Tag("many")],
    Discriminator(_one_or_many),
]


class AdapterTest(_Strict):
    """A test: a message, and the record or rejection to expect."""

    name: str
    """A short description of the test."""
    ros_type: TypeName | None = None
    """The message type; by default the adapter's first."""
    given: Mapping[str, Any]
    """Fields of the message (all others are zero, empty or false), or `{bag, topic, index}`."""
    message: MessageProperties | None = None
    """The properties of the message besides its content; a recorded message has its own properties."""
    parameters: Mapping[str, Scalar] = Field(default_factory=dict)
    """Values of parameters; the others have their defaults."""
    expect: Expected | None = None
    """The expected record, a list of them for an adapter with `rows`, or either by output; fields that are not listed
    are not compared."""
    rejects: str | None = None
    """The message must be rejected with a reason that contains this text."""
    drops: Literal[True] | None = None
    """The message must have no row, because `drop_when` is true or the list of `rows` is empty."""


TypeNames: TypeAlias = Annotated[
    Annotated[TypeName, Tag("one")] | Annotated[Sequence[TypeName], Field(min_length=1), Tag("many")],
    Discriminator(_one_or_many),
]


OntologyReference: TypeAlias = Annotated[
    Annotated[str, Tag("text")] | Annotated[InlineType, Tag("inline")], Discriminator(_type_or_text)
]
"""A known ontology tag, or the declaration of a type."""


class Output(_Strict):
    """One of several topics to which an adapter converts a message."""

    ontology: OntologyReference
    """The ontology type: a known tag, or a declaration."""
    fields: Mapping[str, Value]
    """Column → value."""
    rows: str | None = None
    """A list, as in `transforms[]`: each element becomes a row, and names in `fields` are looked up in the element."""
    drop_when: str | None = None
    """A condition; the output has no row of messages for which it is true."""
    schema_metadata: Mapping[str, Value] = Field(default_factory=dict)
    """Topic metadata, computed from the topic's first row."""


class MappingFile(_Strict):
    """A mapping from messages of one or more ROS types to records of one ontology type."""

    version: Literal[1]
    """The version of the language."""
    adapter: Annotated[str, Field(pattern=_NAME, examples=["BatteryPackAdapter"])]
    """The adapter's name, for `adapters.override` and `use`."""
    description: str | None = None
    """One line for lists of adapters."""
    ros_type: TypeNames | None = None
    """The message type, or a list of types that all have the fields used."""
    variants: Annotated[Mapping[TypeName, Mapping[str, Value]], Field(min_length=1)] | None = None
    """Instead of `ros_type`: types that wrap the same payload. `of` selects the payload; other keys are columns."""
    ontology: OntologyReference | None = None
    """The ontology type: a known tag, or a declaration."""
    default: bool = True
    """Whether the adapter applies to its types without an override."""
    parameters: Mapping[Identifier, Scalar] = Field(default_factory=dict)
    """Parameter → default value, for use by this name in expressions; a manifest sets parameters with
    `load: [{file: …, with: {…}}]`."""
    let: Mapping[Identifier, Scalar] = Field(default_factory=dict)
    """Name → expression, for use by this name in later bindings, `drop_when`, `rows` and `fields`."""
    drop_when: str | None = None
    """A condition; messages for which it is true have no row and count as filtered."""
    rows: str | None = None
    """A list, as in `transforms[]`: each element becomes a row, and names in `fields` are looked up in the element."""
    fields: Mapping[str, Value] | None = None
    """Column → value."""
    outputs: Annotated[Mapping[OutputName, Output], Field(min_length=1)] | None = None
    """Instead of `ontology` and `fields`: name below the topic → output with its own ontology type and fields."""
    schema_metadata: Mapping[str, Value] = Field(default_factory=dict)
    """Topic metadata, computed from the topic's first row."""
    definition: str | None = None
    """The `.msg` text of a type that no distro has, so that the file can be checked and tested without a recording."""
    tests: Sequence[AdapterTest] = ()
    """Tests: messages, and the records or rejections to expect."""

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types that the adapter takes, in the order of the file."""
        if self.variants is not None:
            return tuple(self.variants)
        if self.ros_type is None:
            return ()
        return (self.ros_type,) if isinstance(self.ros_type, str) else tuple(self.ros_type)


class RecordModel(Struct, frozen=True):
    """The content of one output of an adapter file."""

    path: tuple[str, ...]
    """The key path of the output; () if the file has no `outputs`."""
    ontology: str | InlineType | None
    fields: Mapping[str, Value]
    rows: str | None
    drop_when: str | None
    """The condition of the output; the condition of the file applies, too."""
    schema_metadata: Mapping[str, Value]


def records_of(model: MappingFile) -> Mapping[str, RecordModel]:
    """Return the outputs of an adapter file by name; an empty name stands for the only one of a file without `outputs`."""
    if model.outputs is None:
        return {
            "": RecordModel((), model.ontology, model.fields or {}, model.rows, None, model.schema_metadata)
        }
    return {
        name: RecordModel(
            ("outputs", name), one.ontology, one.fields, one.rows, one.drop_when, one.schema_metadata
        )
        for name, one in model.outputs.items()
    }


@cache
def adapter_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of adapter files, for validation and for completion in editors."""
    schema = tidy(schema_of(MappingFile))
    takes = {"oneOf": [{"required": ["ros_type"]}, {"required": ["variants"]}]}
    gives = {"oneOf": [{"required": ["ontology", "fields"]}, {"required": ["outputs"]}]}
    return {"$schema": DIALECT, "title": "mosaico-ingest adapter", **schema, "allOf": [takes, gives]}
