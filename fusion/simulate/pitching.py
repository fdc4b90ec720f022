"""The campaign of a horizontal set-up: the load shifts and pitches on two springs, and its two resonances overlap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fusion.simulate.chirp import Chirp
from fusion.simulate.draws import Draws
from fusion.simulate.preset import NITSCHE2018, PartSpec
from fusion.simulate.suspended import Suspension, write_chirps, write_truth

LOADS = {
    "4kg": PartSpec("load 4 kg", 4.236, 3e-4, (0.0, 0.0, 0.012), 5e-5, (0.0182, 0.0182, 0.0200), 2e-5),
    "7kg": PartSpec("load 7 kg", 6.962, 3e-4, (0.0, 0.0, -0.002), 5e-5, (0.0118, 0.0118, 0.0105), 2e-5),
}
"""Centre of mass above and below the sensor origin; of the second load the resonances overlap."""
STAND = Suspension(
    sensor=replace(NITSCHE2018, name="pitching", rig_name="horizontal shaker"),
    internal=PartSpec("internal", 0.904, 0.002, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0),
    free=(0, 4),
    stiffness=(7.0e8, 1.07e6),
    damping=(2500.0, 4.0),
    loads=LOADS,
    direction=(1.0, 0.0, 0.0),
    base=(-0.12, 0.0, 0.0),
    tops={"top_high": (0.05, 0.0, 0.06), "top_low": (0.05, 0.0, -0.03)},
    chirp=Chirp(period_s=1.28),
)


def write_pitching(folder: Path, seed: int) -> None:
    """Write both rigs, a chirp recording along x of each load, and the truth; everything uncertain is drawn once."""
    draws = Draws(seed, True)
    write_chirps(folder, STAND, draws)
    write_truth(folder, "pitching", STAND, draws, {})
