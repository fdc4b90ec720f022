"""Names and units of axes, motions and loads."""

from __future__ import annotations

from typing import NamedTuple

AXES = ("x", "y", "z")
MOTION_COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
"""Translation along the axes, then rotation about them."""
LOAD_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
LOAD_UNITS = ("N", "N", "N", "N.m", "N.m", "N.m")
MOTION_UNITS = (("m", "m/s", "m/s^2"), ("rad", "rad/s", "rad/s^2"))
"""Units of displacement, velocity and acceleration: of a translation, of a rotation."""


def component_units(order: int) -> tuple[str, ...]:
    """Return the six units of `MOTION_COMPONENTS`, differentiated `order` times (0 to 2)."""
    return tuple(units[order] for units in MOTION_UNITS for _ in AXES)


def load_unit(component: str) -> str:
    """Return the unit of a load component in files: `N.m` for moments, else `N`."""
    return "N.m" if component.startswith("M") else "N"


def sensitivity_unit(output_unit: str, component: str) -> str:
    """Return the ASCII unit of output per load component, `(V/V)/N` or `(V/V)/(N.m)`."""
    numerator = f"({output_unit})" if "/" in output_unit else output_unit
    return f"{numerator}/N" if component.startswith("F") else f"{numerator}/(N.m)"


class MechanicalUnits(NamedTuple):
    """Units of stiffness, damping and inertia of one component."""

    stiffness: str
    damping: str
    inertia: str


def mechanical_units(component: str) -> MechanicalUnits:
    """Return the units of spring, damper and mass for a force or moment."""
    turning = component.startswith("M")
    return MechanicalUnits(*(("N.m/rad", "N.m.s/rad", "kg.m^2") if turning else ("N/m", "N.s/m", "kg")))
