"""Model selection of `shakercal identify`, rotated bases, positions of channels, and refusals."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from identify_factory import DAMPING, LAG_S, QUICK, SENSITIVITY, SINES_HZ, SMALL, STIFFNESS, write_campaign, write_sines
from numpy.typing import NDArray
from support import edit, rows, without_pages

from fusion.base import Settings
from fusion.campaign.run import run_path
from fusion.cli import main
from fusion.errors import FREQUENCIES_NOT_ASCENDING
from fusion.instruments.channel import ChainUncertainty, ChannelReading, observe_channels
from fusion.recording.manifest import ChannelEntry
from fusion.recording.recording_notices import UNKNOWN_NAME
from fusion.recording.rig import ModelChanges
from fusion.recording.toml import to_toml
from fusion.report.folder import Provenance, write_provenance
from fusion.sensitivity.sensitivity_notices import LOAD_UNSTATED
from fusion.sensor import response_notices as raised
from fusion.sensor.identify.identification_evaluation import evaluate_identification, read_curves
from fusion.sensor.identify.identification_inputs import (
    IdentifySettings,
    PreparedTransfer,
    placement_errors,
    prepare,
    read_campaign,
    transducer_placement,
)
from fusion.sensor.identify.identification_report import read_sensor_models
from fusion.sensor.identify.joint_fit import JointFit, joint_fits, mechanics, model_sensitivity
from fusion.simulate.chirp import (
    Chirp,
    SimulatedSuspension,
    chirp_channels,
    chirp_samples,
    chirp_tables,
    rig_file,
    suspension_rig,
    write_chirp_files,
)
from fusion.simulate.preset import PartSpec, read_preset
from fusion.simulate.world import Draws, true_part
from shaker.identification.measured_curves import (
    REFERENCE_INDEX,
    CurveError,
    MeasuredTransfer,
    Placement,
    PlacementError,
)
from shaker.mechanics import MassChain
from shaker.model_notices import NEGATIVE_INERTIA
from shaker.sine.phasor import Phasors

_facing_x = Placement(np.zeros(3), np.array([1.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two chirps, and sines that were not evaluated."""
    folder = write_campaign(tmp_path_factory.mktemp("choices") / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    write_sines(folder)
    return folder


@pytest.fixture
def spoiled(campaign: Path, tmp_path: Path) -> Path:
    """Copy of the campaign, which a test may change."""
    shutil.copytree(campaign, tmp_path / "campaign")
    return tmp_path / "campaign"


@pytest.fixture(scope="module")
def prepared(campaign: Path) -> list[PreparedTransfer]:
    return [prepare(manifest, manifest.name, None)[0] for manifest in read_campaign(campaign).transfers]


def _fit(prepared: list[PreparedTransfer], **choices: object) -> JointFit:
    (found,) = joint_fits(prepared, IdentifySettings(**choices))
    return found


def _moved(
    item: PreparedTransfer, *stages: tuple[str, float, float, float], seed: int | None = None
) -> PreparedTransfer:
    """Recording of a chain of stages (name, mass, stiffness, damping), the last the load's, exact except for noise."""
    ratio, (names, *numbers) = item.measured.ratio, zip(*stages, strict=True)
    value = MassChain(names, *map(np.array, numbers)).transfer(ratio.frequency_hz, names[-1]).value
    if seed is not None:
        draws = np.random.default_rng(seed).standard_normal((len(value), 2, 1))
        parts = np.linalg.cholesky(ratio.covariance) @ draws
        value = value + parts[:, :1, 0] + 1j * parts[:, 1:, 0]
    return replace(item, measured=replace(item.measured, ratio=replace(ratio, value=value)))


def test_one_damping_for_each_recording(prepared):
    fit = _fit(prepared, damping="each")
    found = fit.identification
    names = [f"damping_z: {item.measured.name}" for item in prepared]
    assert list(found.names) == ["stiffness_z", *names, "internal_mass"]
    values = [found.value(name) for name in names]
    assert values == pytest.approx([DAMPING] * 2, rel=0.01)
    vector, covariance = mechanics(fit)
    assert vector[1] == pytest.approx(np.mean(values))
    assert covariance[1, 1] > np.var(values, ddof=1)


def test_changes_stated_by_the_rig_are_in_u(prepared):
    """Springs 0.2 % (frequencies 0.1 %) and damping ratios 5 % with another mounting; U of the masses is unchanged."""
    plain = _fit(prepared).identification
    model = ModelChanges.model_validate(
        {"mounting": {"frequency_uncertainty": 1e-3, "damping_ratio_uncertainty": 0.05}, "load": {}}
    )
    stated = [
        replace(item, manifest=replace(item.manifest, rig=item.manifest.rig.model_copy(update={"model": model})))
        for item in prepared
    ]
    wide = _fit(stated).identification
    added = [np.sqrt(wide.u(name) ** 2 - plain.u(name) ** 2) / wide.value(name) for name in plain.names[:2]]
    np.testing.assert_allclose(added, [2e-3, np.hypot(1e-3, 0.05)], rtol=1e-6)
    assert wide.u("internal_mass") == plain.u("internal_mass")
    # b/k follows the damping ratio over the frequency, as the covariance has it.
    k, b = wide.value("stiffness_z"), wide.value("damping_z")
    slope = np.array([-b / k**2, 1.0 / k])
    assert wide.derived[0].u == pytest.approx(np.sqrt(slope @ wide.covariance[:2, :2] @ slope), rel=1e-3)
    total = np.sqrt(np.sum([change**2 for change in wide.budget.values()], axis=0))
    np.testing.assert_allclose(total, [estimate.u for estimate in wide.estimates], rtol=1e-6)


def test_one_load_uses_the_stated_internal_mass(prepared):
    fit = _fit(prepared[:1])
    assert not fit.mass_is_free
    found = fit.identification["internal_mass"]
    assert abs(found.value - 0.769) < 3.0 * 0.002
    assert found.u == pytest.approx(0.002, rel=1e-3)
    assert "internal_mass as stated" in fit.identification.budget
    assert fit.identification.value("stiffness_z") == pytest.approx(STIFFNESS, rel=2e-3)


def test_compliant_mount_is_fitted_with_the_sensor(prepared):
    adapter = ("adapter", 5.0, 2e9, 6e3)
    moved = [
        _moved(item, adapter, ("sensor", item.load_kg + 0.769, 6e8, 1.5e3), seed=seed)
        for seed, item in enumerate(prepared)
    ]
    fit = _fit(moved, model="adapter")
    found, sensor = fit.identification, fit.identification["stiffness_z"]
    assert abs(sensor.value - 6e8) < 4.0 * sensor.u
    assert abs(found.value("stiffness_z_adapter") - 2e9) < 4.0 * found.u("stiffness_z_adapter")
    assert fit.model == "adapter"
    model = model_sensitivity(fit, None, prepared[0].manifest.rig.sensor).model
    assert (model.stiffness, model.chain.kind, model.unit) == (sensor.value, "none", "(V/V)/N")


def test_negative_internal_mass_gives_a_model_without_one(prepared):
    masses = [prepared[0].load_kg * 0.985, prepared[1].load_kg]
    pairs = zip(prepared, masses, strict=True)
    fit = _fit([_moved(item, ("sensor", mass, STIFFNESS, DAMPING)) for item, mass in pairs])
    assert fit.identification.value("internal_mass") < 0.0
    assert NEGATIVE_INERTIA.code in {notice.code for notice in fit.identification.notices}
    found = model_sensitivity(fit, None, None)
    assert found.model.internal_mass == 0.0
    assert (found.model.sensitivity, found.model.unit) == (1.0, "1/N")


ROD_HZ, HEIGHT_M, JOINT_HZ, CABLE_NPM = 8400.0, 0.1, 9000.0, 4e5


@dataclass(frozen=True)
class ElasticLoadSuspension(SimulatedSuspension):
    """A load that is a uniform rod, on a joint above the sensor's own mass, with a spring to the room at its foot.

    By the wave equation of the rod and Newton's law at the joint, not by modes: foot force m·a·tan(kL)/(kL), motion at
    a height h cos(k(L - h))/cos(kL) times that of the foot.
    """

    joint_hz: float = np.inf
    cable_npm: float = 0.0

    def moved(self, load, internal, frequency_hz):
        """Motion of what the spring moves over that of the base, of the rod's foot over that, and k·L."""
        omega = 2.0 * np.pi * np.maximum(frequency_hz, 1.0)
        angle = 0.5 * np.pi * omega / (2.0 * np.pi * ROD_HZ)
        pulls = load.mass_kg * np.tan(angle) / angle - self.cable_npm / omega**2
        follow = 1.0 - (omega / (2.0 * np.pi * self.joint_hz)) ** 2  # of what is below over the rod's foot
        spring = self.stiffness[0] + 1j * omega * self.damping[0]
        return spring / (spring - omega**2 * (internal.mass_kg + pulls / follow)), 1.0 / follow, angle

    def transfer(self, load, internal, point, frequency_hz):
        below, foot, angle = self.moved(load, internal, frequency_hz)
        return below * foot * np.cos(angle * (1.0 - point[2] / HEIGHT_M)) / np.cos(angle)


def _state_bent(rig: Path, keys: str, mass_kg: float) -> None:
    """State keys of the load and the block of that rod, its modulus known to 0.02 %.

    Without lateral contraction sound runs at 4·L·f.
    """
    density = mass_kg / (np.pi / 4.0 * 0.05**2 * HEIGHT_M)
    modulus = density * (4.0 * HEIGHT_M * ROD_HZ) ** 2
    size = {"length": HEIGHT_M, "diameter": 0.05, "density": density, "poisson_ratio": 0.0}
    stiff = {"young_modulus": modulus, "young_modulus_uncertainty": 2e-4 * modulus}
    rod = to_toml({"load": {"elastic": [{"name": "rod", "shape": "rod", **size, **stiff}]}}).replace("[load]\n", "")
    text = rig.read_text(encoding="utf-8").replace("[load]", f"[load]\n{keys}", 1)
    rig.write_text(f"{text}\n{rod}", encoding="utf-8")


@pytest.mark.parametrize(
    ("stated", "true"),
    [
        ("", {}),
        (f"elastic_frequency = {JOINT_HZ}\nelastic_frequency_uncertainty = 20.0", {"joint_hz": JOINT_HZ}),
        (f"cable_stiffness = [0.0, 0.0, {CABLE_NPM}]\ncable_stiffness_uncertainty = 1e3", {"cable_npm": CABLE_NPM}),
    ],
)
def test_elastic_load_is_in_the_model(tmp_path, stated, true):
    tops = {"top_1": (0.03, 0.0, 0.1), "top_2": (-0.03, 0.0, 0.06)}
    suspension = ElasticLoadSuspension(**(vars(SMALL) | {"tops": tops}), **true)
    folder = write_campaign(tmp_path / "campaign", suspension)
    fits = {}
    for kind in ("bent",) if stated else ("rigid", "bent"):
        for name, load in suspension.loads.items() if kind == "bent" else ():
            _state_bent(folder / rig_file(name), stated, load.mass)
        items = [prepare(manifest, manifest.name, None) for manifest in read_campaign(folder).transfers]
        fits[kind] = _fit([item for item, _ in items]).identification
        codes = [notice.code for _, notices in items for notice in notices]
        assert codes.count(raised.ELASTIC_LOAD.code) == (2 if kind == "bent" else 0)
    internal = true_part(SMALL.internal, Draws(1, True)).mass_kg
    for name, value in (("stiffness_z", STIFFNESS), ("damping_z", DAMPING), ("internal_mass", internal)):
        assert abs(fits["bent"].value(name) - value) < 3.5 * fits["bent"].u(name), name
    assert fits["bent"].chi_squared / fits["bent"].dof == pytest.approx(1.0, abs=0.1)
    if "rigid" in fits:
        assert abs(fits["rigid"].value("stiffness_z") / STIFFNESS - 1.0) > 1e-3


@pytest.mark.slow
def test_sines_of_an_elastic_load_give_the_same_parameters(tmp_path, monkeypatch):
    suspension = ElasticLoadSuspension(**(vars(SMALL) | {"tops": {"top": (0.0, 0.0, 0.1)}}), joint_hz=JOINT_HZ)
    folder = write_campaign(tmp_path / "campaign", suspension)
    write_sines(
        folder, suspension=suspension, below=lambda load, internal, _, hertz: suspension.moved(load, internal, hertz)[0]
    )
    keys = f"elastic_frequency = {JOINT_HZ}\nelastic_frequency_uncertainty = 20.0"
    for name, load in suspension.loads.items():
        _state_bent(folder / rig_file(name), keys, load.mass)
    without_pages(monkeypatch)
    outcomes = run_path(folder, None, Settings())
    assert {outcome.error for outcome in outcomes} == {None}
    (found,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    steps = found.fit.prepared[-1].measured
    assert (len(steps.ratio.frequency_hz), len(steps.bending.names)) == (len(SINES_HZ), len(steps.bending.inertia) - 1)
    alone = _fit(found.fit.prepared[-1:], internal_mass="stated").identification
    assert abs(alone.value("stiffness_z") - STIFFNESS) < 3.5 * alone.u("stiffness_z")
    truth = {"stiffness_z": STIFFNESS, "internal_mass": true_part(SMALL.internal, Draws(1, True)).mass_kg}
    for name, value in truth.items():
        assert abs(found.fit.identification.value(name) - value) < 3.5 * found.fit.identification.u(name), name
    best = found.sensitivity.comparison.best
    assert best.chain.kind == "lag"
    assert abs(best.chain.lag_s - LAG_S) < 3.5 * best.u("lag_s")
    seen = found.sensitivity.measured
    s = 2j * np.pi * seen.frequency_hz
    true = SENSITIVITY / (1.0 + s * DAMPING / STIFFNESS) / (1.0 + s * LAG_S)
    np.testing.assert_allclose(seen.value, true, rtol=5e-4)


def test_two_axes_have_a_result_each(prepared):
    along_x = replace(prepared[0].measured, name="x", drive=np.eye(6)[0], base=_facing_x, tops=(_facing_x,))
    fits = joint_fits([*prepared, replace(prepared[0], measured=along_x)], IdentifySettings(internal_mass="stated"))
    assert [(fit.axis, len(fit.prepared)) for fit in fits] == [("x", 1), ("z", 2)]
    assert "stiffness_x" in fits[0].identification.names


def test_second_peak_selects_pitching(tmp_path):
    suspension = read_preset(SimulatedSuspension, "pitching", chirp=replace(QUICK, period_s=0.32))
    folder = write_campaign(tmp_path / "campaign", suspension)
    found = [prepare(manifest, manifest.name, None)[0] for manifest in read_campaign(folder).transfers]
    fit = _fit(found)
    assert fit.model == "pitching"
    assert "1190." in fit.reason
    names = ("stiffness_x", "stiffness_ry", "damping_x", "damping_ry")
    for name, true in zip(names, (*suspension.stiffness, *suspension.damping), strict=True):
        assert abs(fit.identification.value(name) - true) < 3.3 * fit.identification.u(name)
        assert "damping" in name or fit.identification.value(name) == pytest.approx(true, rel=2e-3)
    drawn = np.hypot(fit.identification.u("internal_mass"), suspension.internal.mass_uncertainty)
    assert abs(fit.identification.value("internal_mass") - suspension.internal.mass) < 3.3 * drawn
    read, _ = read_curves(fit, fit.identification.value("internal_mass"))
    overlapping = [
        r.stiffness / suspension.stiffness[0] for r in read if r.method == "maximum" and "6.962" in r.recording
    ]
    assert max(abs(ratio - 1.0) for ratio in overlapping) > 0.02  # a neighbouring peak distorts the reading
    near = [replace(item, measured=_lines(item.measured, 1100.0, 1300.0)) for item in found[:1]]
    alone = _fit(near, model="translation")
    assert raised.SECOND_PEAK_NOT_EXPLAINED.code in {notice.code for notice in alone.notices}


def _lines(measured: MeasuredTransfer, low_hz: float, high_hz: float) -> MeasuredTransfer:
    """The lines between two frequencies."""
    chosen = (measured.ratio.frequency_hz > low_hz) & (measured.ratio.frequency_hz < high_hz)
    errors = tuple(CurveError(error.name, error.relative[chosen]) for error in measured.errors)
    return replace(measured, ratio=measured.ratio.at_lines(chosen), errors=errors)


def _without_table(path: Path, name: str) -> None:
    """Remove a table from a TOML file."""
    text = path.read_text(encoding="utf-8")
    start = text.index(f"[{name}]")
    end = text.find("\n[", start + 1)
    path.write_text(text[:start] + (text[end + 1 :] if end > 0 else ""), encoding="utf-8")


CHIRP, RIG = "chirp-9kg/recording.toml", "rig-9kg.toml"
CASES = [
    (CHIRP, 'response = ["top"]', 'response = ["base_too"]', UNKNOWN_NAME.code, "excitation.response", "base_too"),
    (
        CHIRP, 'reference = ["base"]', 'reference = ["top"]',
        raised.MISSING_MOTION_CHANNEL.code, "excitation.reference", "base",
    ),
    (CHIRP, 'body = "load"', 'body = "base"', raised.MISSING_MOTION_CHANNEL.code, "excitation.response", "load"),
    (RIG, 'serial = "0815"', 'serial = "0816"', raised.DIFFERENT_SENSOR.code, "sensor.serial", "0816"),
    (
        RIG, 'name = "six-component transducer"', 'name = "another"',
        raised.DIFFERENT_SENSOR.code, "sensor.name", "six-component transducer",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "code", "key", "named"), CASES)
def test_wrong_file_is_refused_at_file_and_key(spoiled, refused, file, old, new, code, key, named):
    edit(spoiled / file, old, new)
    printed = refused("identify", spoiled, "-q")
    assert f"{code} {spoiled / file}: {key}: " in printed
    assert named in printed
    assert not (spoiled / "identify").exists()


def test_incomplete_rigs_are_refused(spoiled, refused):
    _without_table(spoiled / RIG, "load")
    printed = refused("identify", spoiled, "-q")
    assert f"{LOAD_UNSTATED.code} {spoiled / RIG}: load: " in printed
    _without_table(spoiled / "rig-4kg.toml", "sensor")
    printed = refused("identify", spoiled / "chirp-4kg", "-q")
    assert f"{raised.MISSING_IDENTIFICATION_ENTRY.code} {spoiled / 'rig-4kg.toml'}: sensor: " in printed


@pytest.mark.parametrize(
    ("part", "options", "code", "named"),
    [
        ("", ("--band", "9000", "9500"), raised.BAND_WITHOUT_LINES.code, "800"),
        ("", ("--band", "900", "800"), FREQUENCIES_NOT_ASCENDING.code, "--band"),
        ("", ("--model", "pitching"), raised.PITCHING_NOT_DRIVEN.code, "excitation.direction"),
        ("chirp-4kg", ("--internal-mass", "free"), raised.EQUAL_LOAD_MASSES.code, "rig-4kg.toml: load.mass: "),
        ("chirp-4kg", ("--internal-mass", "free"), raised.EQUAL_LOAD_MASSES.code, "in 1 recording"),
        ("sine-0200", (), raised.NO_TRANSFER_RECORDING.code, "excitation.kind: "),
    ],
)
def test_wrong_option_is_refused(campaign, refused, part, options, code, named):
    printed = refused("identify", campaign / part, "-q", *options)
    assert code in printed
    assert named in printed


def test_results_of_other_files_are_refused(spoiled, refused):
    (spoiled / "sine-0200" / "results").mkdir()
    with h5py.File(spoiled / "sine-0200" / "results" / "result.h5", "w") as file:
        write_provenance(file, Provenance({"rig.toml": "0" * 64}, {}, {}, ()), ())
    printed = refused("identify", spoiled, "-q")
    assert raised.OUTDATED_SINE_RESULTS.code in printed
    assert "sine-0200/results/result.h5: " in printed


@pytest.mark.parametrize(
    "choices", [{"model": "rope"}, {"band_hz": (3.0, 2.0)}, {"load_masses_kg": (0.0,)}, {"permitted": 1.0}]
)
def test_invalid_settings_are_refused(choices):
    with pytest.raises(ValueError, match=f"^{next(iter(choices))}: "):
        IdentifySettings(**choices)


K_RY, B_RY, J_I, U_INTERNAL = 1.07e6, 4.0, 1.5e-3, 1e-4  # N·m/rad, N·m·s/rad, kg·m²
LOADS = {"small": (5.0, 0.0, 0.0182), "large": (5.0, 0.0, 0.0412)}  # kg, height of the centre of mass in m, kg·m²
HIGH = {"small": (4.236, 0.012, 0.0182), "large": (6.962, -0.012, 0.0118)}
K_X, B_X, M_I = 7.0e8, 2500.0, 0.9
U_J, U_POSITION, BASE_M, TOP_M = 2e-5, 5e-4, 0.15, 0.09
Load = tuple[float, float, float]
TURNING = read_preset(Chirp, "chirp.chirp", sample_rate_hz=12800.0, period_s=0.64, periods=4, band_hz=(500.0, 1700.0))
ABOUT_Y = [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def _rotated(load: Load, off: float) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
    """Acceleration at the lever of the load over that at the lever of the base, by Cramer's rule.

    (m + m_i) ẍ + m h θ̈ = -(k_x + b_x s) x and m h ẍ + J θ̈ = -(k_ry + b_ry s)(θ - θ_base).
    """
    mass, height, inertia = load

    def ratio(frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        s = 2j * np.pi * frequency_hz
        spring, coupling = K_RY + B_RY * s, mass * height * s * s
        shift = (mass + M_I) * s * s + K_X + B_X * s
        turn = (inertia + J_I + mass * height**2) * s * s + spring
        divisor = shift * turn - coupling**2
        theta, x = spring * shift / divisor, -spring * coupling / divisor
        return np.asarray((x + (TOP_M + off) * theta) / BASE_M)

    return ratio


def _write(folder: Path, *, rate: bool, loads: dict[str, Load] = LOADS, chirp: Chirp = TURNING, seed: int = 3) -> Path:
    """A rig and a chirp for each load; drawn: chains, moments of inertia, position of the load's accelerometer.

    With `rate` the channels are stated to be gyroscopes, whose rate a transfer function turns into an acceleration.
    """
    draws, rng = Draws(seed, True), np.random.default_rng(seed)
    off = 0.0 if rate else U_POSITION * float(rng.standard_normal())
    internal = PartSpec("internal", 0.9, 0.002, (0.0, 0.0, 0.0), 0.0, (J_I, J_I, J_I), U_INTERNAL)
    folder.mkdir()
    for name, (mass, height, inertia) in loads.items():
        part = PartSpec(f"load {name}", mass, 3e-4, (0.0, 0.0, height), 0.0, (inertia,) * 3, U_J)
        (folder / rig_file(name)).write_text(
            to_toml(suspension_rig(read_preset(SimulatedSuspension, "pitching", internal=internal), part, draws))
        )
        true = (mass, height, inertia + U_J * float(rng.standard_normal()))
        samples = chirp_samples(chirp, draws, {"top": _rotated(true, off)}, f"{name}.")
        channels = chirp_channels(chirp, (0.0, 0.0, BASE_M), {"top": (0.0, 0.0, TOP_M)}, (1.0, 0.0, 0.0))
        entries = [_gyroscope(channel) if rate else _placed(channel) for channel in channels]
        tables = chirp_tables(chirp, f"turned, {name}", f"../{rig_file(name)}", entries)
        tables["excitation"]["direction"] = ABOUT_Y
        write_chirp_files(folder / f"chirp-{name}", chirp, samples, tables, {})
    return folder


def _placed(channel: dict[str, Any]) -> dict[str, Any]:
    """An accelerometer; the position of the one on the load is uncertain."""
    return channel | ({"point_uncertainty": U_POSITION} if channel["name"] == "top" else {})


def _gyroscope(channel: dict[str, Any]) -> dict[str, Any]:
    """A gyroscope about y instead of an accelerometer, whose lever is in its scale."""
    lever = BASE_M if channel["name"] == "base" else TOP_M
    stated = channel | {"quantity": "angular_velocity", "direction": [0.0, 1.0, 0.0], "scale": 100.0 / lever}
    del stated["point"]
    return stated


@pytest.mark.parametrize("rate", [False, True])
def test_rotated_base_gives_torsional_stiffness_and_damping(tmp_path, rate):
    folder = _write(tmp_path / "campaign", rate=rate)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    found = component.fit.identification
    assert (component.name, component.fit.model, component.fit.mass_is_free) == ("ry", "translation", True)
    assert found.names == ("stiffness_ry", "damping_ry", "internal_inertia_ry")
    assert [estimate.unit for estimate in found.estimates] == ["N.m/rad", "N.m.s/rad", "kg.m^2"]
    for name, true in zip(found.names, (K_RY, B_RY, J_I), strict=True):
        assert abs(found.value(name) - true) < 3.5 * found.u(name)
    assert found.u("stiffness_ry") < 2e-3 * K_RY
    assert found.u("damping_ry") < 0.02 * B_RY
    names = [unknown.name for unknown in found.unknowns]
    positions = [name for name in names if "point top" in name]
    assert positions == ([] if rate else ["top: point top at (0, 0, 0.09) z [1]"])
    (alone,) = joint_fits(component.fit.prepared[:1], IdentifySettings())
    assert not alone.mass_is_free
    assert alone.identification["internal_inertia_ry"].value == pytest.approx(J_I, abs=1e-6)
    assert alone.identification.u("internal_inertia_ry") == pytest.approx(U_INTERNAL, rel=1e-2)
    assert abs(alone.identification.value("stiffness_ry") - K_RY) < 3.5 * alone.identification.u("stiffness_ry")


def test_files_and_page_have_the_units_of_a_rotation(tmp_path):
    folder = _write(tmp_path / "campaign", rate=False)
    assert main(["identify", str(folder), "-o", str(tmp_path / "out"), "-q"]) == 0
    units = {row["name"]: row["unit"] for row in rows(tmp_path / "out" / "parameters.csv")}
    assert (units["stiffness_ry"], units["damping_ry"]) == ("N.m/rad", "N.m.s/rad")
    assert (units["internal_inertia_ry"], units["lag_ry"]) == ("kg.m^2", "s")
    sensor = read_sensor_models(tmp_path / "out")["My"].sensor
    assert sensor.stiffness == pytest.approx(K_RY, rel=5e-3)
    assert sensor.unit == "(V/V)/(N.m)"
    page = (tmp_path / "out" / "identify.html").read_text(encoding="utf-8")
    assert "load / kg·m²" in page


def test_load_that_also_translates_has_two_modes(tmp_path):
    chirp = replace(TURNING, period_s=0.32, band_hz=(600.0, 2400.0))
    folder = _write(tmp_path / "campaign", rate=False, loads=HIGH, chirp=chirp)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    found = component.fit.identification
    assert (component.name, component.fit.model, component.bands) == ("ry", "pitching", ())
    truth = {"stiffness_ry": K_RY, "stiffness_x": K_X, "damping_ry": B_RY, "damping_x": B_X, "internal_mass": M_I}
    for name, true in {**truth, "internal_inertia_ry": J_I}.items():
        assert abs(found.value(name) - true) < 3.5 * found.u(name)
    assert found.u("stiffness_ry") < 0.01 * K_RY


UNSURE: dict[str, Any] = {
    "point_uncertainty": [1e-3, 2e-3, 3e-3],
    "direction_uncertainty": 5e-3,
    "transverse_sensitivity": 0.02,
}


def _entry(name: str, body: str, **keys: Any) -> ChannelEntry:
    """A channel whose direction is between the axes."""
    stated = {"name": name, "quantity": "acceleration", "body": body, "point": [0.1, -0.02, 0.05]}
    return ChannelEntry.model_validate({**stated, "direction": [0.6, 0.0, 0.8], **UNSURE, **keys})


def _by_name(errors: tuple[PlacementError, ...]) -> dict[str, PlacementError]:
    found = {error.name: error for error in errors}
    assert len(found) == len(errors)
    return found


def test_rows_change_with_position_and_direction():
    entry = _entry("top", "load")
    seen = transducer_placement(entry)
    found = _by_name(placement_errors(_entry("base", "base"), [entry], "1"))
    for axis, u in enumerate(UNSURE["point_uncertainty"]):
        moved = Placement(seen.point_m + u * np.eye(3)[axis], seen.direction)
        change = found[f"top: point top at (0.1, -0.02, 0.05) {'xyz'[axis]} [1]"].change
        np.testing.assert_allclose(change, moved.row - seen.row, atol=1e-15)
    tilts = [error.change for name, error in found.items() if name.startswith("top: direction")]
    assert [float(np.linalg.norm(tilt[:3])) for tilt in tilts] == pytest.approx([5e-3] * 2)
    for tilt in tilts:
        direction = (seen.direction + tilt[:3]) / np.linalg.norm(seen.direction + tilt[:3])
        np.testing.assert_allclose(tilt, Placement(seen.point_m, direction).row - seen.row, atol=3e-5)
    leaks = [error.change for name, error in found.items() if name.startswith("top: transverse")]
    assert [float(np.linalg.norm(leak[:3])) for leak in leaks] == pytest.approx([0.02 / np.sqrt(2.0)] * 2)


def test_unknowns_have_the_names_and_signs_of_a_run():
    entry = _entry("top", "load", common="crystal")
    frequency = np.array([1000.0])
    phasors = Phasors(frequency, np.ones((1, 1), complex), np.eye(2)[None], ("top",), ("m/s2",), np.full(1, np.inf))
    (observed,) = observe_channels([ChannelReading(entry, phasors, ChainUncertainty())])
    placed = {f"{error.name} [B]": error.slope[0, 0] for error in observed.common if error.scope == "mounting"}
    found = {
        name: error.change for name, error in _by_name(placement_errors(entry, [], "B")).items() if np.any(error.change)
    }
    assert set(found) == set(placed)
    for name, change in found.items():
        np.testing.assert_allclose(change, placed[name].real, atol=1e-15)


def test_another_mounting_is_another_unknown_and_exact_positions_have_none():
    base, top = _entry("base", "base"), _entry("top", "load")
    first, repeated, second = (placement_errors(base, [top], mounting) for mounting in ("1", "1", "2"))
    assert [error.name for error in first] == [error.name for error in repeated]
    assert not {error.name for error in first} & {error.name for error in second}
    assert {error.response_index for error in first} == {REFERENCE_INDEX, 0}
    exact = {"point_uncertainty": 0.0, "direction_uncertainty": 0.0, "transverse_sensitivity": 0.0}
    assert placement_errors(_entry("base", "base", **exact), [_entry("top", "load", **exact)], "1") == ()


def test_gyroscope_measures_rotation_at_any_position():
    keys = {"name": "gyro", "quantity": "angular_velocity", "body": "load", "direction": [0.0, 1.0, 0.0]}
    entry = ChannelEntry.model_validate({**keys, "direction_uncertainty": 5e-3})
    assert transducer_placement(entry).row.tolist() == [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    errors = placement_errors(entry, [], "1")
    assert [error.name for error in errors] == [f"gyro: direction gyro along (0, 1, 0) {axis} [1]" for axis in (0, 1)]
    for error in errors:
        assert not np.any(error.change[:3])
        assert float(np.linalg.norm(error.change[3:])) == pytest.approx(5e-3)
        assert error.change[4] == pytest.approx(0.0, abs=1e-15)
