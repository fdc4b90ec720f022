"""Platform data that give measured frequencies: a family of solutions, which validates nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.elastomer.cross import cross_frame, frame_matrices, platform_stiffness
from shaker.models.elastomer.frame import Frame
from shaker.models.elastomer.geometry import CrossBeams
from shaker.models.elastomer.modes import NAMES, centre_of_mass, dense_modes, named_modes
from shaker.models.elastomer.platform import RigidPart
from shaker.notice import Notice

NEEDED = (("Tx", "Ty"), ("Tz",), ("Rx", "Ry"), ("Rz",))
"""Of each group one frequency at least: they fix mass, height and two moments of inertia."""
EXACT = 1e-4
"""Relative misfit below which frequencies count as met."""
PIECES = 3


@dataclass(frozen=True)
class PlatformFit:
    """The rigid `platform` of a `half_size_m` that gives some frequencies; `frequency_hz` (6,) of `NAMES`.

    `misfit`: largest relative departure from a wanted frequency, pairs by their mean. The height's sign is not told by
    frequencies: it is given as positive.
    """

    half_size_m: float
    platform: RigidPart
    frequency_hz: FloatArray
    misfit: float
    notices: tuple[Notice, ...]


def fit_platform(beams: CrossBeams, half_size_m: float, wanted_hz: Mapping[str, float]) -> PlatformFit:
    """Return mass, height and moments of inertia with which the frame has some frequencies in Hz, by name.

    Four unknowns for four distinct frequencies at every half-size: that they are met says nothing for the model, which
    a notice tells. Jx = Jy. Where no platform meets them, the one nearest in relative least squares.
    """
    from scipy.optimize import least_squares

    unknown = [name for name in wanted_hz if name not in NAMES]
    if unknown or any(not any(name in wanted_hz for name in group) for group in NEEDED):
        expected = "one of Tx, Ty, one of Rx, Ry, and Tz, Rz"
        raise ValueError(f"wanted_hz: expected {expected}, found {', '.join(wanted_hz) or 'none'}")
    frame = cross_frame(beams, half_size_m, PIECES)
    targets = np.array([np.mean([wanted_hz[name] for name in group if name in wanted_hz]) for group in NEEDED])
    stiffness = platform_stiffness(frame)

    def misfit(logarithms: FloatArray) -> FloatArray:
        found = _frequencies(frame, _platform(logarithms))
        return np.asarray(np.log([found[NAMES.index(group[0])] for group in NEEDED] / targets))

    fit = least_squares(misfit, _start(stiffness, targets), x_scale=0.1, xtol=1e-10, ftol=1e-14, gtol=1e-12)
    platform, worst = _platform(fit.x), float(np.max(np.abs(np.expm1(fit.fun))))
    return PlatformFit(half_size_m, platform, _frequencies(frame, platform), worst, _notices(half_size_m, worst))


def platform_family(
    beams: CrossBeams, half_sizes_m: Sequence[float], wanted_hz: Mapping[str, float]
) -> tuple[PlatformFit, ...]:
    """Return the fit at every half-size: the family between whose members the frequencies do not choose."""
    return tuple(fit_platform(beams, half_size, wanted_hz) for half_size in half_sizes_m)


def _platform(logarithms: FloatArray) -> RigidPart:
    """The platform of logarithms of mass, height, and two radii of gyration."""
    mass, height, across, along = np.exp(logarithms)
    return RigidPart(float(mass), float(height), mass * np.array([across, across, along]) ** 2)


def _start(stiffness: FloatArray, targets: FloatArray) -> FloatArray:
    """Where to begin: a mass for Tz, a height that lowers Tx to where it is, gyrations for Rx and Rz."""
    omega = (2.0 * np.pi * targets) ** 2
    mass = stiffness[2] / omega[1]
    turning = stiffness[3] / omega[2] / mass
    height = np.clip((stiffness[0] / (omega[0] * mass) - 1.0) * stiffness[3] / stiffness[0], 1e-6, turning)
    gyrations = np.sqrt([max(turning - height, 0.3 * turning), stiffness[5] / omega[3] / mass])
    return np.asarray(np.log(np.concatenate([[mass, np.sqrt(height)], gyrations])))


def _frequencies(frame: Frame, platform: RigidPart) -> FloatArray:
    """Frequencies of the six modes of a frame with a platform."""
    stiffness, mass = frame_matrices(frame, platform)

    def weigh(motion: FloatArray) -> FloatArray:
        return np.asarray(mass @ motion)

    centre = centre_of_mass(weigh, frame.rigid_motions(np.zeros(3)))
    return named_modes(*dense_modes(stiffness, mass, 8), weigh, frame.rigid_motions(centre)).frequency_hz


def _notices(half_size_m: float, worst: float) -> tuple[Notice, ...]:
    """That a fit is no validation, and whether it met the frequencies."""
    where = f"platform of half-size {1e3 * half_size_m:g} mm"
    text = (
        "mass, height and moments of inertia are fitted to the frequencies: other half-sizes meet them too, with other "
        "data, so that agreement does not validate the model; only platform data from a drawing or a balance can"
    )
    notices = [Notice("warning", text, where)]
    if worst > EXACT:
        notices.append(Notice("warning", f"no platform meets all frequencies; {100.0 * worst:.2g} % are left", where))
    return tuple(notices)
