"""Statements about instruments that the models use; the blocks of a manifest provide them."""

from __future__ import annotations

from typing import Protocol

Vector = tuple[float, ...]


class HeadStatement(Protocol):
    """A laser head, or the body of a triaxial accelerometer: lengths in m, angles in rad, sensor axes."""

    @property
    def mirror(self) -> Vector | None:
        """Origin (3,) of the beams."""

    @property
    def mirror_uncertainty(self) -> Vector:
        """Standard uncertainty (3,) of the mirror."""

    @property
    def standoff(self) -> float | None:
        """Distance of the mirror from the points, if the mirror is not stated."""

    @property
    def rotation_uncertainty(self) -> Vector:
        """Standard uncertainty (3,) of the rotation, common to all channels."""

    @property
    def point_uncertainty(self) -> Vector:
        """Standard uncertainty (3,) of the points, common to all channels."""


class NamedHeadStatement(Protocol):
    """A head with its name."""

    @property
    def name(self) -> str:
        """Its name in rig.toml."""

    @property
    def stated(self) -> HeadStatement:
        """Its block in rig.toml."""


class ChannelStatement(Protocol):
    """A channel of a data acquisition system; keys as in docs/recording-format.md, SI units."""

    @property
    def name(self) -> str:
        """Name of the channel."""

    @property
    def quantity(self) -> str:
        """Measured quantity: a key of `TRANSDUCERS`, or force, output, voltage, trigger."""

    @property
    def body(self) -> str | None:
        """Body that carries the measuring point: load, base, room or head."""

    @property
    def point(self) -> Vector | None:
        """Measuring point (3,)."""

    @property
    def point_uncertainty(self) -> Vector:
        """Standard uncertainty (3,) of the point."""

    @property
    def direction(self) -> Vector | None:
        """Direction (3,) of a positive value."""

    @property
    def direction_uncertainty(self) -> float:
        """Standard uncertainty of the direction about each perpendicular axis."""

    @property
    def head(self) -> NamedHeadStatement | None:
        """Head of a laser beam, or body of a triaxial accelerometer."""

    @property
    def channel(self) -> str | None:
        """Component of the load that a sensor output measures."""

    @property
    def scale_uncertainty(self) -> float:
        """Relative standard uncertainty of the scale."""

    @property
    def common(self) -> str | None:
        """Name of the chain that several channels share."""

    @property
    def individual_uncertainty(self) -> float:
        """Relative standard uncertainty of the channel within its chain."""

    @property
    def transverse_sensitivity(self) -> float:
        """Largest relative transverse sensitivity."""

    @property
    def delay_uncertainty(self) -> float:
        """Standard uncertainty of the delay."""

    @property
    def filter_delay_s(self) -> float:
        """Delay of a low-pass whose attenuation is not stated; 0 without one."""


class PairStatement(Protocol):
    """A stereo pair; keys as in docs/recording-format.md, SI units."""

    @property
    def body(self) -> str:
        """Body seen by the cameras: load, base or room."""

    @property
    def support(self) -> str | None:
        """Name of the support of the cameras."""

    @property
    def pose_uncertainty(self) -> Vector:
        """Standard uncertainty (6,) of the pose in the sensor frame."""

    @property
    def scale_uncertainty(self) -> float | None:
        """Relative standard uncertainty of all lengths."""

    @property
    def delay_uncertainty(self) -> float:
        """Standard uncertainty of the delay of the exposure."""
