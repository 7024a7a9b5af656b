"""Inertial, magnetic, satellite, pressure, temperature, battery and joint sensors, and controllers."""

from __future__ import annotations

from typing_extensions import Self

from mosaico_ingest.ontology.geometry import Point3d, Quaternion, Varying, Vector3d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.model import Float32, Float64, Int8, Int32, Serializable, UInt8, UInt16

__all__ = [
    "GPS",
    "IMU",
    "BatteryState",
    "GPSStatus",
    "Joy",
    "Magnetometer",
    "NMEASentence",
    "Pressure",
    "RobotJoint",
    "Temperature",
]


class IMU(Stamped, Serializable):
    """Acceleration and rate of turn of a body, each with its own covariance, 3 by 3."""

    acceleration: Vector3d
    """m/s², gravity included."""
    angular_velocity: Vector3d
    """rad/s."""
    orientation: Quaternion | None = None
    """null where the sensor does not estimate it."""


class Magnetometer(Stamped, Serializable):
    """The field at the sensor."""

    magnetic_field: Vector3d
    """T; its covariance is 3 by 3, T²."""


class GPSStatus(Serializable):
    """How good a fix is."""

    status: Int8
    """-1 no fix, 0 fix, 1 satellite-based, 2 ground-based augmentation."""
    service: UInt16
    """The systems used, one bit each: 1 GPS, 2 GLONASS, 4 COMPASS, 8 Galileo."""
    satellites: Int8 | None = None
    """Satellites in use."""
    hdop: Float64 | None = None
    """Horizontal dilution of precision."""
    vdop: Float64 | None = None
    """Vertical dilution of precision."""


class GPS(Stamped, Serializable):
    """A fix on the WGS 84 ellipsoid."""

    position: Point3d
    """x latitude and y longitude in degrees, z altitude in m; its covariance is 3 by 3, east north up, m²."""
    velocity: Vector3d | None = None
    """m/s."""
    status: GPSStatus | None = None
    """null where the receiver does not say."""


class NMEASentence(Stamped, Serializable):
    """A line of a receiver."""

    sentence: str
    """From `$` on, without the line's end."""


class Pressure(Stamped, Varying, Serializable):
    """An absolute pressure."""

    value: Float64
    """Pa."""


_ICE_K = 273.15


class Temperature(Stamped, Varying, Serializable):
    """An absolute temperature."""

    value: Float64
    """K."""

    @classmethod
    def from_celsius(cls, celsius: float) -> Self:
        """Return the temperature of so many °C."""
        return cls(value=celsius + _ICE_K)

    def to_celsius(self) -> float:
        """Return the temperature in °C."""
        return self.value - _ICE_K


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


class RobotJoint(Stamped, Serializable):
    """The state of joints: one entry a joint in every list, or an empty list where it is not known."""

    names: list[str]
    """The joints' names."""
    positions: list[Float64]
    """rad of a revolute joint, m of a prismatic one."""
    velocities: list[Float64]
    """rad/s or m/s."""
    efforts: list[Float64]
    """N·m or N."""


class Joy(Stamped, Serializable):
    """The state of every axis and button."""

    axes: list[Float32]
    """-1 to 1 each."""
    buttons: list[Int32]
    """0 released, 1 pressed."""
