"""This file finds a model by its tag and imports no more of the ontology than that one needs, for its columns none."""

from __future__ import annotations

from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.columns import builtin_type
from mosaico_ingest.ontology.tags import DEFINED, MODULES

if TYPE_CHECKING:
    from mosaico_ingest.ontology.serializable import Serializable
    from mosaico_ingest.ontology.types import OntologyType

__all__ = ["UnknownTag", "model", "ontology_type", "tags"]


class UnknownTag(AdapterError, KeyError):  # noqa: N818 - the condition, as `NothingMatched`
    """No model has this tag."""


def model(tag: str) -> type[Serializable]:
    """Return the class of a tag: the last one defined with it, otherwise the built-in.

    Raises:
        UnknownTag: There is none; names the nearest.
    """
    if tag not in DEFINED and tag in MODULES:
        import_module(f"mosaico_ingest.ontology.{MODULES[tag]}")
    if tag in DEFINED:
        return DEFINED[tag]
    by_letters = {_letters(known): known for known in tags()}
    near = [by_letters[name] for name in get_close_matches(_letters(tag), by_letters, n=3)]
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(tags())}"
    raise UnknownTag(f"no ontology model has the tag {tag!r}", hint=hint)


def ontology_type(tag: str) -> OntologyType:
    """Return tag, columns and serialization format of a tag.

    Raises:
        UnknownTag: There is none; names the nearest.
    """
    return builtin_type(tag) if tag in MODULES else model(tag).ontology_type()


def tags() -> tuple[str, ...]:
    """Return every known tag in alphabetical order."""
    return tuple(sorted({*MODULES, *DEFINED}))


def _letters(tag: str) -> str:
    """Return the tag without what older tags, as `vector_3_d`, spell differently."""
    return tag.replace("_", "").lower()
