"""Names and units of axes, loads and motions, in the order in which every array of six components has them."""

from __future__ import annotations

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
    """Return the unit of a load component as it stands in files: `N.m` of moments, `N` of all else."""
    return "N.m" if component.startswith("M") else "N"
