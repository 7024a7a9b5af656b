"""Time, Duration, Header and Message."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, SerializeAsAny
from typing_extensions import Self

from mosaico_ingest.ontology.model import Int32, Serializable, UInt32, UInt64

_SECOND = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class _SecondsAndNanoseconds(BaseModel):
    """A signed time span in two parts; `nanoseconds` is never negative."""

    seconds: Int32
    """Seconds, rounded down."""
    nanoseconds: Annotated[UInt32, Field(lt=_SECOND)]
    """Remaining nanoseconds, in [0, 1e9)."""

    @classmethod
    def from_nanoseconds(cls, nanoseconds: int) -> Self:
        """Return the span for a number of ns."""
        seconds, rest = divmod(nanoseconds, _SECOND)
        return cls(seconds=seconds, nanoseconds=rest)

    def to_nanoseconds(self) -> int:
        """Return the span in ns, exactly."""
        return self.seconds * _SECOND + self.nanoseconds

    @classmethod
    def from_milliseconds(cls, milliseconds: int) -> Self:
        """Return the span for a number of ms."""
        return cls.from_nanoseconds(milliseconds * 1_000_000)

    def to_milliseconds(self) -> int:
        """Return the span in ms, rounded down."""
        return self.to_nanoseconds() // 1_000_000

    @classmethod
    def from_float(cls, seconds: float) -> Self:
        """Return the span nearest to a number of seconds."""
        return cls.from_nanoseconds(round(seconds * _SECOND))

    def to_float(self) -> float:
        """Return the span in s; a double resolves about 0.2 µs of a present-day time."""
        return self.to_nanoseconds() / _SECOND


class Time(_SecondsAndNanoseconds, Serializable):
    """A point in time, since the epoch or since the start of a simulation."""

    @classmethod
    def from_datetime(cls, moment: datetime) -> Self:
        """Return the time of a `datetime`; one without a time zone counts as UTC."""
        aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        return cls.from_nanoseconds((aware - _EPOCH) // timedelta(microseconds=1) * 1000)

    def to_datetime(self) -> datetime:
        """Return the time in UTC, rounded down to microseconds."""
        return _EPOCH + timedelta(microseconds=self.to_nanoseconds() // 1000)

    @classmethod
    def now(cls) -> Self:
        """Return the current time."""
        return cls.from_datetime(datetime.now(timezone.utc))


class Duration(_SecondsAndNanoseconds, Serializable):
    """A span of time; a negative one has negative `seconds`."""


class Header(Serializable):
    """The sender's time stamp and the coordinate frame of the values."""

    timestamp: Time | None = None
    """The time stamp on the sender's clock."""
    frame_id: str | None = None
    """The coordinate frame."""
    sample_counter: UInt64 | None = None
    """A counter of the sender, such as `seq` in ROS 1."""


class Stamped(BaseModel):
    """The base of all models with a header, which is their first column."""

    header: Header | None = None
    """Time stamp and frame of the values; null if the sender set neither."""


_Model = TypeVar("_Model", bound=Serializable)


def _ontology_object(value: object) -> object:
    """Return an ontology object of this package or of the official SDK."""
    if not isinstance(value, BaseModel) or not hasattr(value, "ontology_tag"):
        raise ValueError(f"{type(value).__name__} is no ontology object")
    return value


class Message(BaseModel):
    """A row with its log time."""

    model_config = ConfigDict(extra="forbid", defer_build=True)

    timestamp_ns: int
    """Log time, ns since the epoch."""
    data: Annotated[SerializeAsAny[Serializable], PlainValidator(_ontology_object)]
    """The row."""

    def get_data(self, model: type[_Model]) -> _Model | None:
        """Return the row if it is an instance of `model`, else None."""
        return self.data if isinstance(self.data, model) else None

    def ontology_tag(self) -> str:
        """Return the tag of the row."""
        return self.data.ontology_tag()
