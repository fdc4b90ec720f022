"""What no record shows of a model, as rig.toml states it: against formulas, draws, and the numbers that rest on it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import rows

from fusion.cli import main
from fusion.estimation.coverage import coverage_factor
from fusion.recording.load import load_manifest
from fusion.recording.rig import ElasticMode, ModelChange, ModelChanges, Rig, TemperatureChange
from fusion.recording.toml import validate
from fusion.sensor.compensate.compensation_evaluation import evaluate_compensation
from fusion.sensor.compensate.compensation_subjects import CompensationSettings, read_sources
from fusion.sensor.model_files import ModelEntry, ModelsFile, models_text
from fusion.sensor.model_notices import MODEL_COVERAGE
from fusion.sensor.step.step_pool import OF_RELEASES, index_quantities, of_models, pool_models
from fusion.sensor.unmodelled_effects import stated_influences
from shaker.decoupling.model import MultiModel
from shaker.lti.indices import indices
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.load_model import LoadModel, load_curve

MASS, SPRING, DAMPER, LAG_HZ = 0.24, 2.4e6, 15.0, 6000.0
RIG = Rig(
    format=1,
    name="r",
    model=ModelChanges(
        mounting=ModelChange(frequency_uncertainty=1e-3, damping_ratio_uncertainty=0.02, gain_uncertainty=3e-4),
        temperature=TemperatureChange(difference_uncertainty=5.0, frequency_coefficient=-1.2e-4, gain_coefficient=2e-4),
    ),
)
ONE, TWO = stated_influences(RIG, ["1"]), stated_influences(RIG, ["1", "2"])


def modal(system: LinearSystem, covariance: bool = True) -> ModalModel:
    """The modal form of a system with modes above the real axis, and real poles."""
    residues, upper = system.residues(), system.poles.imag > 0
    real = system.poles.imag == 0
    poles = system.poles[upper]
    size = 4 * int(upper.sum()) + 2 * int(real.sum())
    frequency, decay = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
    parts = (-system.poles[real].real / (2 * np.pi), residues[real].real)
    return ModalModel(frequency, decay, residues[upper], *parts, 1e-18 * np.eye(size) if covariance else None)


def mechanics(spring: float, damper: float, gain: float) -> LinearSystem:
    """A mass on a spring and a damper, gain times displacement over that at rest, behind a lag."""
    lag = 2 * np.pi * LAG_HZ
    bottom = np.polymul([MASS, damper, spring], [1.0 / lag, 1.0])
    return LinearSystem.from_coefficients(np.array([gain * spring]), bottom)


def chain(spring: float, damper: float) -> LinearSystem:
    """Two masses in a row: the motion of the lower one over a force on it, with the zeros of the upper one."""
    upper, link, drag = 0.05, 0.4 * spring, 0.4 * damper
    first = np.polyadd([MASS, damper + drag, spring + link], [0.0])
    second, both = np.array([upper, drag, link]), np.array([drag, link])
    return LinearSystem.from_coefficients(second, np.polysub(np.polymul(first, second), np.polymul(both, both)))


def test_changes_are_those_of_springs_and_dampers():
    """Frequencies by 1 % are springs by 1.01² and dampers by 1.01; the lag of the amplifier stays."""
    model = modal(mechanics(SPRING, DAMPER, 2.0))
    stiffer = modal(mechanics(1.01**2 * SPRING, 1.01 * DAMPER, 2.0)).vector
    assert model.altered(frequency=0.01).vector == pytest.approx(stiffer, rel=1e-8)
    damped = modal(mechanics(SPRING, 1.02 * DAMPER, 2.0 * 1.003)).vector
    assert model.altered(damping_ratio=0.02, gain=0.003).vector == pytest.approx(damped, rel=1e-8)


def test_zeros_move_with_the_mechanics():
    """With zeros too: exact for springs, to first order in the damping for dampers."""
    model, stiffer = modal(chain(SPRING, DAMPER)), modal(chain(1.01**2 * SPRING, 1.01 * DAMPER))
    hertz = np.linspace(1.0, 1500.0, 300)
    gain = chain(SPRING, DAMPER).static_gain / chain(1.01**2 * SPRING, 1.0).static_gain
    assert model.altered(frequency=0.01).response(hertz) == pytest.approx(gain * stiffer.response(hertz), rel=1e-7)
    damped = modal(chain(SPRING, 1.1 * DAMPER)).response(hertz)
    moved, before = model.altered(damping_ratio=0.1).response(hertz), model.response(hertz)
    assert np.max(np.abs(moved - damped)) < 0.02 * np.max(np.abs(damped - before))


def test_every_output_of_several_moves_alike():
    one, two = modal(chain(SPRING, DAMPER)), modal(chain(SPRING, DAMPER))
    residue = np.stack([one.residue, -0.02 * two.residue], axis=1)[:, :, None]
    shared = one.frequency_hz, one.damping_ratio, residue, one.real_hz, np.zeros((0, 2, 1))
    several = MultiModel(("Fz", "Mx"), ("Fz",), "V", *shared, covariance=np.zeros((12, 12)))
    known, hertz = stated_influences(RIG, ["1"]), np.array([0.0, 200.0, 480.0])
    response = several.altered(0.01, 0.1).response(hertz)
    assert response[:, 0, 0] == pytest.approx(one.altered(0.01, 0.1).response(hertz))
    assert response[:, 1, 0] == pytest.approx(-0.02 * response[:, 0, 0])
    u = known.on_outputs(several).u
    assert u.frequency_hz / several.frequency_hz == pytest.approx(np.hypot(1e-3, 6e-4), rel=1e-6)
    assert u.damping_ratio / several.damping_ratio == pytest.approx(0.02, rel=1e-6)


def test_what_is_stated_is_in_every_number_of_a_model():
    """With f = sqrt(k/m)/2π: u of f as stated, of a band as it moves with the springs, of the gain by both causes."""
    model = modal(mechanics(SPRING, DAMPER, 2.0))
    found = index_quantities(pool_models(of_models([model]), ["1"], 0.0, ONE), None, "V/N", 50e3, ONE)
    number = {one.name: one for one in found.quantities}
    hertz = np.sqrt(SPRING / MASS) / (2 * np.pi)
    assert number["natural_hz"].value == pytest.approx(hertz, rel=1e-9)
    assert number["natural_hz"].u == pytest.approx(hertz * np.hypot(1e-3, 1.2e-4 * 5.0), rel=1e-4)
    assert number["damping_ratio"].u == pytest.approx(0.02 * number["damping_ratio"].value, rel=1e-4)
    assert number["static_gain"].u == pytest.approx(2.0 * np.hypot(3e-4, 2e-4 * 5.0), rel=1e-4)
    assert np.isinf(number["natural_hz"].dof)
    for one in found.quantities:
        if one.name in found.budget[OF_RELEASES]:
            parts = [own[one.name] for own in found.budget.values()]
            assert np.linalg.norm(parts) == pytest.approx(one.u, rel=1e-6), one.name
    band = number["band_10_hz"]
    stiff = index_quantities(pool_models(of_models([model.altered(1e-3)]), ["1"]), None, "V/N", 50e3).quantities
    moved = next(one.value for one in stiff if one.name == "band_10_hz") - band.value
    assert found.budget["mounting anew"]["band_10_hz"] == pytest.approx(moved, rel=0.03)


def test_several_mountings_take_the_place_of_what_is_stated_of_one():
    assert ONE.scope == "within this record of one release, with mounting anew and another temperature as stated"
    assert (ONE.single, ONE.missing) == (True, ("load", "structure"))
    assert TWO.scope == "for these 2 releases in 2 mountings, with another temperature as stated"
    assert TWO.causes == ("temperature",)
    assert stated_influences(Rig(format=1, name="r"), ["1"]).scope == "within this record of one release"


def test_a_model_over_the_load_keeps_its_springs_and_masses():
    """Resonance and damping with any load move as stated; masses do not."""
    base = LoadModel("Fz", "Fz", "V", 0.24, 2.36e6, 6.0, 1.89e6, 4.0, 0.4, covariance=1e-12 * np.eye(4))
    known = stated_influences(RIG, ["1"] * 3, ("load",)).on_loads(base)
    curve = load_curve(known, np.array([0.0, 0.05, 0.2]))
    there = np.isfinite(curve.frequency_hz)
    expected = np.hypot(1e-3, 6e-4)
    assert (curve.u_frequency_hz / curve.frequency_hz)[there] == pytest.approx(expected, rel=1e-4)
    assert (curve.u_damping_ratio / curve.damping_ratio)[there] == pytest.approx(0.02, rel=1e-3)
    assert known.u_sensitivity == pytest.approx(0.4 * np.hypot(3e-4, 1e-3))
    assert np.sqrt(known.total_covariance[4, 4]) < 1e-9


def stored(folder: Path, model: ModalModel, **more: object) -> Path:
    """A models.json of one output."""
    entry = ModelEntry("Fz", "Fz", "V", "pencil", model, 50e3, 1e-5, "a, b, c", **more)
    folder.mkdir(exist_ok=True)
    (folder / "models.json").write_text(models_text(ModelsFile("bench", "s", "7", (entry,))), encoding="utf-8")
    return folder


def test_numbers_of_a_filter_rest_on_what_is_stated_and_on_degrees_of_freedom(tmp_path):
    plain = modal(mechanics(SPRING, DAMPER, 2.0))
    stated = pool_models(of_models([plain]), ["1"], 0.0, ONE).model
    wish = CompensationSettings(frequency_hz=1000.0, damping_ratio=0.6)

    def made(model: ModalModel, **more: object):
        folder = stored(tmp_path, model, **more)
        return evaluate_compensation(read_sources([folder]), wish, None, {})

    alone, known = (made(model).filters[0] for model in (plain, stated))
    for name in ("natural_hz", "band_10_hz", "overshoot"):
        assert alone.before.u[name] < 1e-3 * known.before.u[name]
    # springs and dampers moved by one standard uncertainty of each cause, under the filter of those that were not
    size = np.hypot(1e-3, 6e-4)
    others = mechanics((1.0 + size) ** 2 * SPRING, (1.0 + size) * DAMPER, 2.0), mechanics(SPRING, 1.02 * DAMPER, 2.0)
    overshoots = [indices(other.times(known.compensation.system)).overshoot for other in others]
    changes = np.array(overshoots) - known.after.indices.overshoot
    assert known.after.u["overshoot"] == pytest.approx(np.linalg.norm(changes), rel=0.05)
    # half of the variance of the frequency is scatter of three releases
    scatter = 0.5 * np.asarray(stated.covariance)
    evaluation = made(stated, dof=2.0, scatter=scatter, scope="within these 3 releases", outside="")
    filters = evaluation.filters[0]
    dof = 2.0 * (1.0 + 0.5 / (0.5 * (1.0 + 2.0 / 2.0))) ** 2  # Welch, Satterthwaite; s² enlarged by 2/ν
    assert filters.before.dof["natural_hz"] == pytest.approx(dof)
    assert filters.sensor_dof[0] == pytest.approx(dof)
    assert filters.before.expanded("natural_hz") == pytest.approx(coverage_factor(dof) * known.before.u["natural_hz"])
    (coverage,) = (notice for notice in evaluation.notices if notice.code == MODEL_COVERAGE.code)
    assert coverage.values["scope"] == "within these 3 releases"
    old = made(stated, dof=2.0).filters[0]  # a file that does not say what of it is scatter: all
    assert old.before.expanded("natural_hz") == pytest.approx(4.303 * known.before.u["natural_hz"], rel=1e-3)


def test_keys_are_taken_as_certificates_state_them(tmp_path):
    text = {
        "format": 1,
        "name": "r",
        "model": {
            "mounting": {"frequency_uncertainty": {"U_relative": 0.004, "k": 2.0, "certificate": "mountings 2025"}},
            "temperature": {"difference_uncertainty": {"U": 3.0, "distribution": "uniform"}},
        },
    }
    model = validate(Rig, text, tmp_path / "rig.toml").model
    assert model.mounting.frequency_uncertainty == 0.002
    assert model.temperature.difference_uncertainty == pytest.approx(np.sqrt(3.0))
    own = {"participation": [0.0] * 6, "displacement": {"top": [0.0, 0.0, 1.0]}}
    text = {"frequency": {"value": 600.0, "U": 4.0, "k": 2.0}, **own}
    assert validate(ElasticMode, text, tmp_path / "rig.toml").frequency_uncertainty == 2.0  # Hz, as plain ones


@pytest.mark.usefixtures("no_pages")
def test_from_rig_toml_to_the_tables(tmp_path, capsys):
    """A simulated campaign whose rig says what mounting changes: in indices, budget, models.json and the filter."""
    assert main(["simulate", str(tmp_path / "steps"), "--preset", "steps"]) == 0
    campaign = tmp_path / "steps"
    with (campaign / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write("\n[model.mounting]\nfrequency_uncertainty = 0.01\n")
    recording = campaign / "Fz-fishing-line-1"
    assert load_manifest(recording / "recording.toml").rig.model.mounting.frequency_uncertainty == 0.01
    assert main(["step", str(recording), "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr()
    assert "mounting anew" in told.out
    (row,) = (r for r in rows(tmp_path / "out" / "indices.csv") if r["name"] == "natural_hz")
    assert float(row["u"]) / float(row["value"]) == pytest.approx(0.01, rel=1e-3)
    parts = {r["cause"]: r for r in rows(tmp_path / "out" / "budget.csv") if r["name"] == "natural_hz"}
    assert float(parts["mounting anew"]["u"]) == pytest.approx(0.01 * float(row["value"]), rel=1e-3)
    assert (parts["another load"]["u"], parts["another load"]["status"]) == ("", "not assessed")
    (entry,) = json.loads((tmp_path / "out" / "models.json").read_text(encoding="utf-8"))["models"]
    assert entry["scope"].endswith("with mounting anew as stated")
    assert main(["compensate", str(tmp_path / "out"), "--frequency", "3000", "-o", str(tmp_path / "filter")]) == 0
    (before,) = (r for r in rows(tmp_path / "filter" / "compensate.csv") if r["name"] == "before_natural_hz")
    assert float(before["u"]) == pytest.approx(float(row["u"]), rel=1e-3)
