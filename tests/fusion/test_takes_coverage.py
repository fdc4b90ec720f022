"""Takes with every error drawn from what is stated: regions of motion and sensitivity hold the truth."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom
from take_factory import BASE_Z, BRIDGE_V, FREQUENCY_HZ, LOAD, MASS_KG, POINTS, RIG, SENSITIVITY, at_point

from fusion.estimation.measurement_model import ChainUncertainty, Reading, observe_channels
from fusion.phasors.setup import OpenTake, Referral, referrals
from fusion.phasors.setups import pool_readings
from fusion.recording.load import validate
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Rig
from fusion.sensitivity.analyse import Analysis, Inputs, analyse
from fusion.sensitivity.body import Body, make_part
from shaker.lines.frequencies import Lines
from shaker.sine.phasor import Phasors

OMEGA = 2.0 * np.pi * FREQUENCY_HZ
NOISE = 2e-5  # relative, of real and imaginary part
SCALE_U, OUTPUT_U, TIE_U_S = 2.5e-4, 1e-4, 4e-7
DRIFT = 0.005
LINES = Lines(np.array([FREQUENCY_HZ]), np.zeros(1), np.array([106.25]), np.array([1]), ("",), ())


def _entry(**given: object) -> ChannelEntry:
    return ChannelEntry.model_validate({"scale_uncertainty": SCALE_U, **given})


REFERENCE = _entry(
    name="drive", quantity="acceleration", body="base", point=[0, 0, -0.1], direction=[0, 0, 1], reference=True
)
OUTPUT = ChannelEntry.model_validate(
    {"name": "Fz", "quantity": "output", "channel": "Fz", "scale": BRIDGE_V, "scale_uncertainty": OUTPUT_U}
)
LASERS = [
    _entry(name="velocity", quantity="velocity", body="load", point=list(p), direction=[0, 0, 1], common="laser")
    for p in POINTS
]


def _reading(entry: ChannelEntry, value: complex, rng: np.random.Generator, clock: str, u_clock_s: float) -> Reading:
    """A channel's phasor with noise and what its noise is stated to be."""
    spread = NOISE * abs(value)
    noisy = value + spread * complex(*rng.normal(size=2))
    phasors = Phasors(
        LINES.frequency_hz,
        np.array([[noisy]]),
        (spread**2 * np.eye(2))[None],
        (entry.name,),
        ("1",),
        np.array([1e4]),
    )
    return Reading(entry, phasors, ChainUncertainty(clock=clock, u_clock_s=u_clock_s))


def _takes(rng: np.random.Generator, drift: float) -> list[OpenTake]:
    """Eight takes of one laser point each; the output has a clock of its own, tied anew in every take."""
    laser, drive = 1.0 + SCALE_U * rng.normal(size=2)
    bridge = 1.0 + OUTPUT_U * rng.normal()
    takes = []
    for number, entry in enumerate(LASERS, 1):
        grown = drift * rng.normal() if number > 1 else 0.0
        level = (1.0 + grown) * np.exp(2j * np.pi * rng.random()) if number > 1 else 1.0
        other = 1.0 + abs(grown) * complex(*rng.uniform(-1.0, 1.0, size=2))  # what else changed with the level
        late = np.exp(-1j * OMEGA * TIE_U_S * rng.normal())
        motion = at_point(entry.point or ()) / (1j * OMEGA)
        force = SENSITIVITY * MASS_KG * LOAD[2]
        readings = (
            _reading(REFERENCE, level * drive * BASE_Z, rng, "vibrometer", 0.0),
            _reading(entry, level * other * laser * motion, rng, "vibrometer", 0.0),
            _reading(OUTPUT, level * other * bridge * force * late, rng, "bridge", TIE_U_S),
        )
        nowhere: object = SimpleNamespace(path=Path("recording.toml"))
        takes.append(OpenTake(f"take {number}", "", nowhere, nowhere, (), (), LINES, (), readings))  # type: ignore[arg-type]
    return takes


def _referred(take: OpenTake, referral: Referral) -> list[Reading]:
    own = [referral.reference(r) if r.entry.reference else referral.reading(r) for r in take.readings]
    return own if referral.first else own[1:]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    import tomllib

    return validate(Rig, tomllib.loads(RIG), tmp_path_factory.mktemp("rig") / "rig.toml")


def _analyse(rng: np.random.Generator, rig: Rig, drift: float) -> Analysis:
    takes = _takes(rng, drift)
    tied = referrals(takes)
    readings, _ = pool_readings([(r.name, _referred(take, r)) for take, r in zip(takes, tied, strict=True)])
    body = Body((make_part("load", MASS_KG, (0, 0, 0), np.zeros((3, 3)), (0, 0, 0)),))
    outputs = tuple(reading for reading in readings if reading.entry.quantity == "output")
    assert len(outputs) == 1
    return analyse(Inputs(LINES, observe_channels(readings), outputs, body, None, rig.sensor, (0.0, 0.0, 1.0)))


def _inside(error: complex, covariance: np.ndarray) -> bool:
    vector = np.array([error.real, error.imag])
    return float(vector @ np.linalg.solve(covariance, vector)) < 5.991


def _count(rig: Rig, trials: int, drift: float) -> list[int]:
    """How often the 95 % regions of both bodies' acceleration along z and of the sensitivity hold the truth."""
    rng, hits = np.random.default_rng(21), np.zeros(3, dtype=np.int64)
    for _ in range(trials):
        found = _analyse(rng, rig, drift)
        ratio = found.sensitivity
        assert ratio is not None
        for place, (body, truth) in enumerate((("load", LOAD[2]), ("base", BASE_Z))):
            motion = next(a.phasors for a in found.accelerations if a.body == body)
            z = motion.covariance[0][np.ix_([2, 8], [2, 8])]
            hits[place] += _inside(complex(motion.value[0, 2] - truth), z)
        hits[2] += _inside(complex(ratio.value[0, 0, 2] - SENSITIVITY), ratio.covariance[0, 0, 2])
    return [int(count) for count in hits]


def test_regions_hold_the_truth(rig: Rig) -> None:
    trials = 30
    for hits in _count(rig, trials, DRIFT):
        assert binom.cdf(hits, trials, 0.95) > 1e-3  # as often as a perfect estimator's, or more


@pytest.mark.slow
@pytest.mark.parametrize("drift", [0.0, DRIFT])
def test_regions_hold_the_truth_as_often_as_stated(rig: Rig, drift: float) -> None:
    trials = 150
    for hits in _count(rig, trials, drift):
        assert binom.cdf(hits, trials, 0.95) > 1e-3
        assert hits < trials  # no larger than needed


def test_noise_of_the_reference_is_one_error_of_all_takes(rig: Rig) -> None:
    """With an exact laser, what the mean of eight points knows is limited by the first take's reference."""
    rng = np.random.default_rng(2)
    found = _analyse(rng, rig, 0.0).accelerations[0].uncertainty
    budget = {part.label: np.sqrt(part.covariance[0, 2, 2]) / abs(LOAD[2]) for part in found.grouped()}
    # Seven of eight points carry the first reference's noise and their own, the eighth neither.
    assert NOISE * 0.3 < budget["reference noise"] < NOISE * 1.05
    names = {influence.name for influence in found.influences if influence.label == "reference noise"}
    assert len(names) == 16
    assert {influence.scope for influence in found.influences if influence.label == "reference noise"} == {"recording"}
