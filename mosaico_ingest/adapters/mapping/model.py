"""The model of an adapter file, its JSON Schema, and ontology types defined inline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from mosaico_ingest.documents import DIALECT, schema_of, tidy
from mosaico_ingest.ontology.types import SerializationFormat

__all__ = [
    "AdapterTest",
    "FieldDeclaration",
    "FieldType",
    "InlineType",
    "MappingFile",
    "RecordedMessage",
    "Scalar",
    "Value",
    "ValueForm",
    "adapter_schema",
]


def _plain(value: object) -> object:
    """Refuse what is no plain value, once and not once for each type it is not."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise PydanticCustomError("plain_value", "it is an expression, a number, true, false or null")


Scalar: TypeAlias = Annotated[bool | int | float | str | None, BeforeValidator(_plain)]
TypeName: TypeAlias = Annotated[
    str, Field(pattern=r"^[A-Za-z]\w*/(msg/)?[A-Za-z]\w*$", examples=["sensor_msgs/msg/Imu"])
]
_NAME = r"^[A-Za-z_]\w*$"


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
    """A value that needs more than an expression; one of `value`, `use` and `fields` says where it comes from."""

    value: Scalar = None
    """An expression."""
    map: Annotated[Mapping[Scalar, Scalar], Field(min_length=1)] | None = None
    """What `value` becomes, by value or by the name of a constant of the message."""
    otherwise: Annotated[
        Scalar, Field(alias="else", default="error", examples=["error", "keep", "'unknown'"])
    ]
    """What a value that is not in `map` becomes: `error` rejects the row, `keep` keeps it, or an expression."""
    use: str | None = None
    """The adapter that makes the record of the nested message `of`."""
    of: str | None = None
    """An expression: the nested message (`a.b`), or the messages of a list (`a[]`)."""
    fields: Mapping[str, Value] | None = None
    """Field of the struct → value; names are read inside `of` where that is given."""
    replaced: Annotated[Mapping[str, Value] | None, Field(alias="with")] = None
    """Fields of the resulting struct that come from elsewhere; names are read outside `of`."""
    when: str | None = None
    """A condition; where it does not hold, the whole value is null."""


Value: TypeAlias = Annotated[
    Annotated[Scalar, Tag("scalar")] | Annotated[ValueForm, Tag("form")], Discriminator(_form_or_scalar)
]
"""Text is an expression; numbers, `true`, `false` and `null` are themselves; a mapping is a `Form`."""


class FieldDeclaration(_Strict):
    """A field of an ontology type of one's own."""

    type: str | None = None
    """As `float32`, `list[float64]`, `list[float64, 9]`, or an ontology tag."""
    fields: Mapping[str, FieldType] | None = None
    """The fields of a nested struct; with `type: list`, of each struct in a list."""
    nullable: bool = True
    """Whether a row may have no value."""
    unit: str | None = None
    """As `m/s`; for the reader."""
    description: str | None = None
    """For the reader."""


FieldType: TypeAlias = Annotated[
    Annotated[str, Tag("text")] | Annotated[FieldDeclaration, Tag("inline")], Discriminator(_type_or_text)
]


class InlineType(_Strict):
    """An ontology type of one's own."""

    tag: Annotated[str, Field(pattern=_NAME, examples=["WheelTicks"])]
    """The name that readers find it by."""
    format: Annotated[SerializationFormat, Field(strict=False)] = SerializationFormat.DEFAULT
    """How the platform lays it out."""
    fields: Annotated[Mapping[str, FieldType], Field(min_length=1)]
    """Column → type."""


class RecordedMessage(_Strict):
    """A recorded message."""

    bag: str
    """A recording; relative to the adapter file."""
    topic: str
    """The topic in it."""
    index: Annotated[int, Field(ge=0)] = 0
    """Which of the topic's messages."""


class AdapterTest(_Strict):
    """What must come out of what."""

    name: str
    """What the test shows."""
    ros_type: TypeName | None = None
    """Which of the adapter's types; the first if not said."""
    given: Mapping[str, Any]
    """Fields of the message (those not named are zero, empty, false), or `{bag, topic, index}`."""
    expect: Mapping[str, Any] | None = None
    """What is compared; fields not named may be anything."""
    rejects: str | None = None
    """The row must be rejected, for a reason that contains this."""


TypeNames: TypeAlias = Annotated[
    Annotated[TypeName, Tag("one")] | Annotated[Sequence[TypeName], Field(min_length=1), Tag("many")],
    Discriminator(_one_or_many),
]


class MappingFile(_Strict):
    """How messages of one or more ROS types become records of one ontology type."""

    version: Literal[1]
    """The version of this language."""
    adapter: Annotated[str, Field(pattern=_NAME, examples=["BatteryPackAdapter"])]
    """The adapter's name, for `adapters.override` and `use`."""
    description: str | None = None
    """One line for lists of adapters."""
    ros_type: TypeNames | None = None
    """The message type, or types that all have the fields that are named."""
    variants: Annotated[Mapping[TypeName, Mapping[str, Value]], Field(min_length=1)] | None = None
    """Instead of `ros_type`: types that wrap the same payload. `of` says where it is; other keys are fields."""
    ontology: Annotated[
        Annotated[str, Tag("text")] | Annotated[InlineType, Tag("inline")], Discriminator(_type_or_text)
    ]
    """The ontology type: a known tag, or one of one's own."""
    default: bool = True
    """Whether it is used for its types without being asked for."""
    fields: Mapping[str, Value]
    """Column → value."""
    schema_metadata: Mapping[str, Value] = Field(default_factory=dict)
    """What the topic's metadata says, read from the first row."""
    definition: str | None = None
    """The `.msg` text of a type that no distro knows, so that the tests run without a recording."""
    tests: Sequence[AdapterTest] = ()
    """Messages and what must come out of them."""

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The types it takes, in the order written."""
        if self.variants is not None:
            return tuple(self.variants)
        if self.ros_type is None:
            return ()
        return (self.ros_type,) if isinstance(self.ros_type, str) else tuple(self.ros_type)


@cache
def adapter_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) that editors complete and check adapter files with."""
    schema = tidy(schema_of(MappingFile))
    takes = [{"required": ["ros_type"]}, {"required": ["variants"]}]
    return {"$schema": DIALECT, "title": "mosaico-ingest adapter", **schema, "oneOf": takes}
