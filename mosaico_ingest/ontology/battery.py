"""This file is batteries."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float32, UInt8
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["BatteryState"]


class BatteryState(Stamped, Serializable):
    """The state of a battery; null is a value the sender does not measure."""

    voltage: Float32
    """V."""
    temperature: Float32 | None = None
    """°C."""
    current: Float32 | None = None
    """A, negative while discharging."""
    charge: Float32 | None = None
    """Ah left."""
    capacity: Float32 | None = None
    """Ah when last full."""
    design_capacity: Float32 | None = None
    """Ah when new."""
    percentage: Float32
    """0 to 1."""
    power_supply_status: UInt8
    """0 unknown, 1 charging, 2 discharging, 3 not charging, 4 full."""
    power_supply_health: UInt8
    """0 unknown, 1 good, 2 overheat, 3 dead, 4 over-voltage, 5 failure, 6 cold, 7 watchdog, 8 safety timer."""
    power_supply_technology: UInt8
    """0 unknown, 1 NiMH, 2 Li-ion, 3 Li-polymer, 4 LiFe, 5 NiCd, 6 LiMn."""
    present: bool
    """Whether there is a battery."""
    location: str
    """The slot it is in."""
    serial_number: str
    """Of the battery."""
    cell_voltage: list[Float32] | None = None
    """V each."""
    cell_temperature: list[Float32] | None = None
    """°C each."""
