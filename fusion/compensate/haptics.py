"""The force-feedback check: a loop through the sensor without filter, with one for no load, and with its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.compensate.result import SubjectResult
from fusion.compensate.wish import COMMAND, Wish
from fusion.errors import InputError
from shaker.models.compensation.discrete import Sections, sampled
from shaker.models.compensation.filter import Compensation
from shaker.models.feedback import FeedbackRun, HapticLoop, largest_stable_gain, push, simulate_feedback
from shaker.models.linear_system import LinearSystem

HAND_STIFFNESS, HAND_DAMPING = 500.0, 5.0
HANDLE_MASS, HANDLE_DAMPING = 0.8, 2.0
PUSH_M, WALL_M, PUSH_S = 0.03, 0.005, 0.5
"""How far the hand moves, where the ball begins on its way, and how long it takes."""
BEYOND, HALF = 10.0, 0.5
"""The shared gain over the largest stable one of the filter for no load, but at most half that of the own filter."""


@dataclass(frozen=True)
class HapticCase:
    """One way to treat the sensor's signal: `largest_gain` of the force control at which the loop is stable.

    `own_error`: tracking error at half of it; `run`: at the gain that all cases share.
    """

    name: str
    largest_gain: float
    own_error: float
    run: FeedbackRun


@dataclass(frozen=True)
class Haptics:
    """The check of one channel with a load of `load_mass` in kg at the shared force gain `gain`."""

    channel: str
    load_mass: float
    gain: float
    ball_stiffness: float
    cases: tuple[HapticCase, ...]


def check_haptics(results: Sequence[SubjectResult], wish: Wish) -> Haptics | None:
    """Run the check for the first force whose load is modelled, with its heaviest load; None where none is wanted."""
    if wish.ball_stiffness is None:
        return None
    found = next((one for one in results if one.subject.is_scheduled and one.subject.load_unit == "N"), None)
    if found is None:
        expected = "a model of a force over the load (load.json) for --ball"
        raise InputError(COMMAND, "--ball", found="none", expected=expected)
    own = max(found.filters, key=lambda one: one.load_mass or 0.0)
    mass, rate = own.load_mass or 0.0, own.sections.sample_rate_hz
    unloaded = Compensation(found.subject.dynamics(0.0, wish.modes, real_poles=False), own.compensation.target)
    sensor = own.compensation.sensor.system
    ways: dict[str, Sections | None] = {
        "no filter": None,
        "filter for no load": sampled(unloaded, rate, wish.discretisation),
        f"filter for {1e3 * mass:.4g} g": own.sections,
    }
    loop = HapticLoop(HAND_STIFFNESS, HAND_DAMPING, HANDLE_MASS, HANDLE_DAMPING, wish.ball_stiffness, 0.0, rate)
    limits = [largest_stable_gain(loop, sensor, sections) for sections in ways.values()]
    shared = min(BEYOND * limits[1], HALF * limits[2])
    cases = [
        _case(name, replace(loop, force_gain=HALF * limit), shared, sensor, sections)
        for (name, sections), limit in zip(ways.items(), limits, strict=True)
    ]
    return Haptics(found.subject.name, mass, shared, wish.ball_stiffness, tuple(cases))


def _case(name: str, loop: HapticLoop, shared: float, sensor: LinearSystem, sections: Sections | None) -> HapticCase:
    """One case at half its own largest gain, and at the shared one."""
    hand = push(np.arange(round(PUSH_S * loop.sample_rate_hz)) / loop.sample_rate_hz, PUSH_M, PUSH_S)
    alone, together = (
        simulate_feedback(replace(loop, force_gain=gain), sensor, sections, hand, wall_m=WALL_M)
        for gain in (loop.force_gain, shared)
    )
    return HapticCase(name, loop.force_gain / HALF, alone.tracking_error, together)
