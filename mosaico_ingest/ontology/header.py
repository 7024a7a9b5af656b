"""Time, Duration, Header and Message."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, SerializeAsAny
from typing_extensions import Self

from mosaico_ingest.ontology.model import Int32, Serializable, UInt32, UInt64

__all__ = [
    "Duration",
    "Header",
    "Message",
    "Stamped",
    "Time",
]

_SECOND = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class _SecondsAndNanoseconds(BaseModel):
    """A signed number of nanoseconds in two parts, the second of which always counts upwards."""

    seconds: Int32
    """Whole seconds, rounded down."""
    nanoseconds: Annotated[UInt32, Field(lt=_SECOND)]
    """What remains, ns in [0, 1e9)."""

    @classmethod
    def from_nanoseconds(cls, nanoseconds: int) -> Self:
        """Return the same span, given in ns."""
        seconds, rest = divmod(nanoseconds, _SECOND)
        return cls(seconds=seconds, nanoseconds=rest)

    def to_nanoseconds(self) -> int:
        """Return the span in ns, exactly."""
        return self.seconds * _SECOND + self.nanoseconds

    @classmethod
    def from_milliseconds(cls, milliseconds: int) -> Self:
        """Return the same span, given in ms."""
        return cls.from_nanoseconds(milliseconds * 1_000_000)

    def to_milliseconds(self) -> int:
        """Return the span in ms, rounded down."""
        return self.to_nanoseconds() // 1_000_000

    @classmethod
    def from_float(cls, seconds: float) -> Self:
        """Return the span nearest to `seconds`."""
        return cls.from_nanoseconds(round(seconds * _SECOND))

    def to_float(self) -> float:
        """Return the span in s; a double keeps about 0.2 µs of a present-day time."""
        return self.to_nanoseconds() / _SECOND


class Time(_SecondsAndNanoseconds, Serializable):
    """A moment, counted from the epoch (or from the start of a simulation)."""

    @classmethod
    def from_datetime(cls, moment: datetime) -> Self:
        """Return the moment of an aware `datetime`; one without a zone counts as UTC."""
        aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        return cls.from_nanoseconds((aware - _EPOCH) // timedelta(microseconds=1) * 1000)

    def to_datetime(self) -> datetime:
        """Return the moment in UTC, rounded down to the microsecond."""
        return _EPOCH + timedelta(microseconds=self.to_nanoseconds() // 1000)

    @classmethod
    def now(cls) -> Self:
        """Return the present moment."""
        return cls.from_datetime(datetime.now(timezone.utc))


class Duration(_SecondsAndNanoseconds, Serializable):
    """A span of time; a negative one has negative `seconds`."""


class Header(Serializable):
    """When a message was stamped by its sender, and the frame its values are in."""

    timestamp: Time | None = None
    """The sender's clock."""
    frame_id: str | None = None
    """The coordinate frame."""
    sample_counter: UInt64 | None = None
    """A number the sender counts up; ROS 1's `seq`."""


class Stamped(BaseModel):
    """The first column of everything that has a header."""

    header: Header | None = None
    """Time and frame of the values; null where the sender gave none."""


_Model = TypeVar("_Model", bound=Serializable)


def _ontology_object(value: object) -> object:
    """Return the value as it is; the official SDK's own objects are as good as ours."""
    if not isinstance(value, BaseModel) or not hasattr(value, "ontology_tag"):
        raise ValueError(f"{type(value).__name__} is no ontology object")
    return value


class Message(BaseModel):
    """The envelope around a row."""

    model_config = ConfigDict(extra="forbid", defer_build=True)

    timestamp_ns: int
    """When it was recorded, ns since the epoch."""
    data: Annotated[SerializeAsAny[Serializable], PlainValidator(_ontology_object)]
    """The row itself."""

    def get_data(self, model: type[_Model]) -> _Model | None:
        """Return the row where it is a `model`, None otherwise."""
        return self.data if isinstance(self.data, model) else None

    def ontology_tag(self) -> str:
        """Return the tag of the row."""
        return self.data.ontology_tag()
