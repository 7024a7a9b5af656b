"""This file is the adapter's seam: rows in the ROS shape in, rows in the ontology's shape out."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.diagnostics import RowFailure
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.types import OntologyType

__all__ = ["Adapted", "Adapter", "AdapterSpec", "Envelope"]


@frozen
class Envelope:
    """What is known of the rows beside their content."""

    topic: str
    msgtype: str
    log_times: NDArray[np.int64]
    """ns since the epoch, shape (n,)."""


@frozen
class Adapted:
    """The rows that fit, which of the given rows they were, and the ones that did not."""

    rows: pa.StructArray
    """Type = the ontology's struct."""
    index: NDArray[np.int64]
    """Position among the given rows, ascending, shape (len(rows),)."""
    failures: tuple[RowFailure, ...]
    log_times: NDArray[np.int64] | None = None
    """Times to store instead of the recorded ones, shape (len(rows),); only a Python `translate` changes them."""


class Adapter(Protocol):
    """An adapter bound to one message definition."""

    @property
    def ontology(self) -> OntologyType:
        """What the rows become."""
        ...

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a whole batch; a row that does not fit is a failure, the others go on.

        Raises:
            AdapterError: The adapter itself is broken; no row can be adapted.
        """
        ...

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return what the platform should know of the topic's configuration; {} by default."""
        ...


class AdapterSpec(Protocol):
    """An adapter before it meets a definition: cheap, picklable, what registries and plans hold."""

    @property
    def name(self) -> str:
        """As `IMUAdapter`."""
        ...

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types it takes, as `sensor_msgs/msg/Imu`."""
        ...

    @property
    def default(self) -> bool:
        """Whether it is used for its types without being asked for."""
        ...

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Check the adapter against the real definition and make it ready.

        Raises:
            AdapterError: A field it needs is not there or has another type; names the fields that are.
        """
        ...
