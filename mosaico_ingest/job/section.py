"""The base class of manifest sections, and the annotated types that several sections use."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from typing_extensions import Self

from mosaico_ingest.job.fields import Parsed, TopicGlob
from mosaico_ingest.job.units import format_time, parse_limit, parse_time
from mosaico_ingest.job.values import Limit, TimeBound

_MAX_COUNT = 1_000_000_000


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
