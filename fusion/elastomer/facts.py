"""The numbers of the beam formulas: as the publication's formulas give them, and as mechanics does."""

from __future__ import annotations

import numpy as np

from fusion.elastomer.definition import Definition
from fusion.elastomer.result import Fact, Mounted
from shaker.models.elastomer.element import FrameModel
from shaker.models.elastomer.modes import NAMES
from shaker.models.elastomer.oscillators import MountedChain, mounted_hz
from shaker.models.elastomer.statics import (
    PublishedStatics,
    beam_stiffness,
    guided_stiffness,
    oscillator_hz,
    required_stiffness,
)

PRINTED_SHARE = 0.4
"""F_Q/F of equation 10."""


def statics_facts(definition: Definition, frame: FrameModel) -> tuple[Fact, ...]:
    """Return shear modulus, force shares, stiffnesses and frequencies, printed formula beside the right one."""
    beams, mass = definition.beams, definition.platform.mass_kg
    printed, closed = PublishedStatics(beams), beam_stiffness(beams, definition.file.platform.half_size)
    point, first = guided_stiffness(beams), float(frame.modes.frequency_hz[0])
    stiffness = printed.stiffness(PRINTED_SHARE)
    ratio = printed.force_ratio / 4.0
    guided, cantilever = "compliant beams guided at mid-span", "compliant beams as cantilevers"
    shear = beams.material.shear_modulus_pa
    return (
        Fact("shear_modulus", "shear modulus G", printed.shear_modulus_pa, shear, "Pa", "E/(1+μ) printed for E/2(1+μ)"),
        Fact("force_ratio", "F_Q/F_c, eq. 10", printed.force_ratio, ratio, "1", f"{cantilever}; printed value 8"),
        Fact("beam_share", "F_Q/F, eq. 10", printed.beam_share, ratio / (2 * ratio + 4), "1", "printed value 0.4"),
        Fact("stiffness_point", "k, platform a point, eq. 11", stiffness, point, "N/m", f"F_Q = 0.4 F; {guided}"),
        Fact("stiffness_x", "k along x, y with the platform", None, closed.x, "N/m", "closed form, no turning"),
        Fact("stiffness_z", "k along z with the platform", None, closed.z, "N/m", "closed form, no turning"),
        Fact(
            "frequency_point",
            "f of k and the moving mass, eq. 17",
            oscillator_hz(stiffness, mass),
            oscillator_hz(point, mass),
            "Hz",
            f"platform and parts, {1e3 * mass:.4g} g",
        ),
        Fact(
            "stiffness_needed",
            "k that the frame's Tx asks of one oscillator",
            None,
            required_stiffness(first, mass),
            "N/m",
            f"{first:.1f} Hz with the same mass",
        ),
    )


def mounted_chain(definition: Definition, frame: FrameModel) -> Mounted | None:
    """Return the sensor between hand and pedestal, with the frame's stiffness and the mass that its frequency means."""
    told = definition.file.mounting
    if told is None:
        return None
    place = NAMES.index(told.direction)
    stiffness = float(frame.stiffness[place])
    mass = stiffness / (2.0 * np.pi * float(frame.modes.frequency_hz[place])) ** 2
    chain = MountedChain(
        mass_kg=np.array([told.hand_mass, mass, told.pedestal_mass]),
        stiffness=np.array([told.hand_stiffness, stiffness, told.pedestal_stiffness]),
        damping=np.array([told.hand_damping, told.sensor_damping, told.pedestal_damping]),
    )
    frequency, damping = chain.modes()
    top = told.hand_mass or mass
    hands = np.linspace(0.0, 2.0 * top, 81)
    return Mounted(told.direction, stiffness, mass, frequency, damping, hands, mounted_hz(stiffness, mass, hands))
