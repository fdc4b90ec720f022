"""A Monte Carlo run from all that a manifest can state at once, against first order, and name by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import violations as rigs

from fusion.base import Settings
from fusion.estimation.measurement_model import Deviates
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Analysis, Inputs
from fusion.sensitivity.distributions import MonteCarlo, Propagated
from fusion.sensitivity.monte_carlo import propagate
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.sensitivity.sensitivity_notices import FIRST_ORDER_TOO_SMALL
from fusion.simulate.sines import driven, rendered_run, write_run
from fusion.simulate.violations import violations
from fusion.simulate.world import Draws, make_world

DRAWS = 4000
STAND_OFF_M = 0.7027
SENSOR = """temperature_coefficient = { value = -4e-4, U = 1e-4, k = 2.2, dof = 12 }
reference_temperature = 23.0
base_strain_sensitivity = 4e-2
"""
ROD = """[[load.elastic]]
name = "rod"
shape = "rod"
length = 0.12
length_uncertainty = 1e-4
diameter = 0.06
young_modulus = 2.0e11
young_modulus_uncertainty = 4e9
density = 7850.0
density_uncertainty = 20.0
damping = 0.002
damping_uncertainty = 0.001

[environment]
latitude = 52.3
height = 70.0
down = [0.0, 0.0, -1.0]
gravity_uncertainty = 2e-3
support_motion = 2e-3
base_strain = 5e-6
sensor_temperature = { value = 26.0, U = 0.8, k = 2.0, dof = 8 }
"""
HEADS = """
[head.scanner]
mirror = [0.0, 0.0, 0.8]
mirror_uncertainty = 0.002
rotation_uncertainty = 0.002
point_uncertainty = 0.0005

[head.triaxial]
rotation_uncertainty = 0.003
point_uncertainty = 0.0005

[shaker]
transverse_motion = 0.05
rocking_motion = 0.02
"""


def recorded(folder: Path, replaced: dict[str, str]) -> Path:
    """Simulate beams of one mirror with points of the base, and state all there is to state; x, y, rz stay unseen.

    `replaced`: further patterns of rig.toml and what stands there instead.
    """
    rig = rigs.Rig(frames=12)
    motion = np.array([[1.2, 1.0, 60.0, 2.0, 2.0, 2.0], [0.01, 0.01, 0.24, 0.05, 0.05, 0.05]])
    phases = np.exp(2j * np.pi * np.random.default_rng(18).uniform(size=motion.shape))
    preset = driven(rigs.preset_of(rig), "Fz", rig.frequency_hz, motion * phases)
    draws = Draws(1, True, violations=violations([f"scanner-fan={STAND_OFF_M}"], preset))
    recording = write_run(folder, rendered_run(preset), make_world(preset, draws, rigs.JITTER_S), draws)
    recording = recording if recording.suffix else recording / "recording.toml"
    stated = (folder / "rig.toml").read_text(encoding="utf-8")
    for pattern, text in {
        r'(?<=unit = "V/V"\n)': SENSOR,
        r"mass = 6.9605\nmass_uncertainty = .*": "mass = { value = 6.9605, U = 0.0016, k = 2.3, dof = 9 }",
        r"\[environment\]\ngravity = .*\n": ROD,
        **replaced,
    }.items():
        stated, count = re.subn(pattern, text, stated, count=1)
        assert count == 1, pattern
    (folder / "rig.toml").write_text(stated + HEADS, encoding="utf-8")
    blocks = []
    for plain in recording.read_text(encoding="utf-8").split("\n\n"):
        block = plain
        if '"velocity"' in block:
            block = re.sub("direction = .*", 'head = "scanner"', block)
            block = re.sub("direction_uncertainty = .*", "direction_uncertainty = 5e-4", block)
        elif 'name = "acceleration_z"' in block:
            scale = "scale_uncertainty = { U_relative = 0.006, k = 2.0, dof = 20 }"
            block = re.sub("scale_uncertainty = .*", f'{scale}\nhead = "triaxial"', block)
        if not any(out in block for out in ('name = "acceleration_x"', 'name = "acceleration_y"', 'stereo = "top"')):
            blocks.append(block)
    recording.write_text("\n\n".join(blocks), encoding="utf-8")
    return recording


VARIANTS = {
    "static matrix": {r'(?<=unit = "V/V"\n)(?=temp)': "cross_talk_uncertainty = 2e-3\n"},
    "rated cross-talk": {r"static_sensitivity = .*": "cross_talk = 0.01"},
}


@pytest.fixture(scope="module", params=list(VARIANTS))
def propagated(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    """Inputs and first-order analysis of a recording, and its Monte Carlo run."""
    known: list[tuple[Inputs, Analysis]] = []

    def kept(inputs: Inputs, analysis: Analysis, *rest: object) -> MonteCarlo:
        known.append((inputs, analysis))
        return propagate(inputs, analysis, *rest)

    recording = recorded(tmp_path_factory.mktemp("stated"), VARIANTS[request.param])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.sensitivity.recording_evaluation.propagate", kept)
        evaluation = evaluate_recording(load_manifest(recording), Settings(monte_carlo=DRAWS, seed=1))
    return *known[0], evaluation.monte_carlo


def parts(result: Propagated, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of Re and Im of an element in the draws, and by first order."""
    place = result.elements.index(name)
    return tuple(np.sqrt(c[0, place].diagonal()) for c in (result.covariance, result.first_covariance))


DRIVEN = {"acceleration of the load": "z", "load": "Fz", "sensitivity": "Fz per Fz", "element": "Fz per Fz"}


def test_draws_of_all_that_is_stated_agree_with_first_order_or_it_is_said_where_not(propagated):
    _, _, drawn = propagated
    results = {result.name: result for result in drawn.results}
    assert set(DRIVEN) <= set(results)
    reported = " ".join(n.values["quantities"] for n in drawn.notices if n.code == FIRST_ORDER_TOO_SMALL.code)
    for name, result in results.items():
        for place, element in enumerate(result.elements):
            both = (result.magnitude, result.phase)
            # 3.3 of the draws' own 1/√(2N), and 5 %; of widths, since few edges of a clock make a Student's t.
            slack = 0.05 + 3.3 / np.sqrt(2.0 * DRAWS)
            widths = [(b.high - b.low)[0, place] / (b.first_high - b.first_low)[0, place] for b in both]
            if not result.weak[0, place] and max(widths) > 1.0 + slack:
                assert f"{name} ({element}" in reported, (name, element, widths)
            if DRIVEN.get(name) == element and f"{name} ({element}" not in reported:
                np.testing.assert_allclose(widths, 1.0, atol=slack, err_msg=name)
                # Few edges of a clock make a Student's t of the phase; the magnitude rests on what is known.
                ratio = result.magnitude.u[0, place] / result.magnitude.first_u[0, place]
                np.testing.assert_allclose(ratio, 1.0, atol=3.3 / np.sqrt(2.0 * DRAWS), err_msg=name)


ALIKE = re.compile(r"(?P<part>load|internal mass) [0-9.]+ kg: (?P<what>mass|centre of mass|inertia).*")


def name_drawn(name: str) -> str:
    """Return under which name the run draws an unknown: numbers of a part together, a leak by its angle."""
    if "transverse sensitivity" in name:
        return name[:-1] + "0"
    part = ALIKE.fullmatch(name)
    return f"{part['part']}: {part['what']}" if part else name


def drawing(monkeypatch: pytest.MonkeyPatch, active: Callable[[str], bool]) -> set[str]:
    """Keep all unknowns but the active ones at their estimates; return the set of names that will be drawn."""
    names: set[str] = set()
    normal, angle = Deviates.normal, Deviates.angle

    def some(self: Deviates, name: str, *shape: int) -> np.ndarray:
        names.add(name)
        return normal(self, name, *shape) if active(name) else np.zeros((self.count, *shape))

    def turned(self: Deviates, name: str, *shape: int) -> np.ndarray:
        names.add(name)
        return angle(self, name, *shape) if active(name) else np.full((self.count, *shape), np.pi)

    monkeypatch.setattr(Deviates, "normal", some)
    monkeypatch.setattr(Deviates, "angle", turned)
    return names


def test_every_unknown_of_first_order_is_drawn_with_its_size(propagated, monkeypatch):
    inputs, analysis, _ = propagated
    drawn: set[str] = set()
    with monkeypatch.context() as patch:
        drawn = drawing(patch, lambda name: True)
        propagate(inputs, analysis, 400, 1)
    for found, result, place in ((analysis.load, "load", 2), (analysis.element, "element", None)):
        uncertainty = found.uncertainty
        at = found.elements.index((2, 2)) if place is None else place
        wanted = {i.name: name_drawn(i.name) for i in uncertainty.influences}
        assert set(wanted.values()) <= drawn
        size = uncertainty.covariance.shape[1] // 2
        total = np.trace(uncertainty.covariance[0][np.ix_([at, at + size], [at, at + size])])
        labels = dict.fromkeys(influence.label for influence in uncertainty.influences)
        for label in labels:
            own = [influence for influence in uncertainty.influences if influence.label == label]
            first = sum(i.effect[0, at] ** 2 + i.effect[0, at + size] ** 2 for i in own)
            if first < 2e-3 * total:
                continue
            own_names = {name_drawn(influence.name) for influence in own}
            with monkeypatch.context() as patch:
                drawing(patch, lambda name, own=own_names: name in own)
                (alone,) = [r for r in propagate(inputs, analysis, 700, 1).results if r.name == result]
            spread, _ = parts(alone, "Fz" if place is not None else "Fz per Fz")
            # Student's t of few degrees of freedom spreads more; frozen motion that nobody observes adds a little.
            assert 0.88 < np.sqrt(np.sum(spread**2) / first) < 1.25, (result, label)
