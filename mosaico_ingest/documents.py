"""The base of JSON documents (reports, plans, inspections), and JSON Schemas of models.

Pydantic's `use_attribute_docstrings` would read the source of every class at each import; here only the schema reads it.
"""

from __future__ import annotations

import ast
import inspect
import json
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import CoreSchema, core_schema
from pydantic_core.core_schema import ModelSchema
from typing_extensions import Self

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import escape_undecodable

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_MAX_MESSAGE = 200
"""Maximum length of a schema violation in an error message, as it repeats the value."""


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


_Model = TypeVar("_Model", bound=BaseModel)


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
