"""Inertial, magnetic, satellite, pressure, temperature, battery and joint sensors, and controllers."""

from __future__ import annotations

from typing_extensions import Self

from mosaico_ingest.ontology.geometry import Point3d, Quaternion, Varying, Vector3d
from mosaico_ingest.ontology.model import Float32, Float64, Int8, Int32, Serializable, Stamped, UInt8, UInt16


class IMU(Stamped, Serializable):
    """Acceleration and angular velocity of a body, each with a 3 x 3 covariance."""

    acceleration: Vector3d
    """Acceleration including gravity, m/s²."""
    angular_velocity: Vector3d
    """rad/s."""
    orientation: Quaternion | None = None
    """Orientation; null if the sensor does not estimate it."""


class Magnetometer(Stamped, Serializable):
    """The magnetic field at the sensor."""

    magnetic_field: Vector3d
    """T; the covariance is 3 x 3, in T²."""


class GPSStatus(Serializable):
    """The quality of a position fix."""

    status: Int8
    """-1 no fix, 0 fix, 1 satellite-based augmentation, 2 ground-based augmentation."""
    service: UInt16
    """The satellite systems in use, one bit each: 1 GPS, 2 GLONASS, 4 COMPASS, 8 Galileo."""
    satellites: Int8 | None = None
    """Number of satellites in use."""
    hdop: Float64 | None = None
    """Horizontal dilution of precision."""
    vdop: Float64 | None = None
    """Vertical dilution of precision."""


class GPS(Stamped, Serializable):
    """A position on the WGS 84 ellipsoid."""

    position: Point3d
    """x is latitude and y longitude in degrees, z is altitude in m; the covariance is 3 x 3, east-north-up, in m²."""
    velocity: Vector3d | None = None
    """m/s."""
    status: GPSStatus | None = None
    """Quality of the fix; null if the receiver does not report it."""


class NMEASentence(Stamped, Serializable):
    """An NMEA sentence of a receiver."""

    sentence: str
    """The text from `$`, without the line end."""


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
        """Return the temperature for a value in °C."""
        return cls(value=celsius + _ICE_K)

    def to_celsius(self) -> float:
        """Return the temperature in °C."""
        return self.value - _ICE_K


class BatteryState(Stamped, Serializable):
    """The state of a battery; null for values that the sender does not measure."""

    voltage: Float32
    """V."""
    temperature: Float32 | None = None
    """°C."""
    current: Float32 | None = None
    """A, negative while discharging."""
    charge: Float32 | None = None
    """Remaining charge, Ah."""
    capacity: Float32 | None = None
    """Last full capacity, Ah."""
    design_capacity: Float32 | None = None
    """Design capacity, Ah."""
    percentage: Float32
    """Charge as a fraction, 0 to 1."""
    power_supply_status: UInt8
    """0 unknown, 1 charging, 2 discharging, 3 not charging, 4 full."""
    power_supply_health: UInt8
    """0 unknown, 1 good, 2 overheat, 3 dead, 4 over-voltage, 5 failure, 6 cold, 7 watchdog, 8 safety timer."""
    power_supply_technology: UInt8
    """0 unknown, 1 NiMH, 2 Li-ion, 3 Li-polymer, 4 LiFe, 5 NiCd, 6 LiMn."""
    present: bool
    """Whether a battery is present."""
    location: str
    """The slot or position of the battery."""
    serial_number: str
    """The battery's serial number."""
    cell_voltage: list[Float32] | None = None
    """Voltage of each cell, V."""
    cell_temperature: list[Float32] | None = None
    """Temperature of each cell, °C."""


class RobotJoint(Stamped, Serializable):
    """The state of joints: one entry per joint in every list; a list is empty if its values are unknown."""

    names: list[str]
    """Names of the joints."""
    positions: list[Float64]
    """rad for a revolute joint, m for a prismatic joint."""
    velocities: list[Float64]
    """rad/s or m/s."""
    efforts: list[Float64]
    """N·m or N."""


class Joy(Stamped, Serializable):
    """The state of a controller's axes and buttons."""

    axes: list[Float32]
    """-1 to 1 each."""
    buttons: list[Int32]
    """0 for released, 1 for pressed."""
