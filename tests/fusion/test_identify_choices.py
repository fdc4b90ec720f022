"""Which model `shakercal identify` takes and why, what its options do, and campaigns that it refuses."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identify_factory import DAMPING, QUICK, SMALL, STIFFNESS, write_campaign, write_sines

from fusion.cli import main
from fusion.sensor.identify.fit import JointFit, joint_fits, mechanics, modelled
from fusion.sensor.identify.measured import IdentifySettings, Prepared, prepare, read_campaign
from fusion.simulate import chirp as pitching
from shaker.identification.measured import MeasuredTransfer, RelativeError, Sight
from shaker.mechanics import MassChain

_facing_x = Sight(np.zeros(3), np.array([1.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two chirps, and sines that were not evaluated."""
    folder = write_campaign(tmp_path_factory.mktemp("choices") / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    write_sines(folder)
    return folder


@pytest.fixture
def spoiled(campaign: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    shutil.copytree(campaign, tmp_path / "campaign")
    return tmp_path / "campaign"


@pytest.fixture(scope="module")
def prepared(campaign: Path) -> list[Prepared]:
    return [prepare(manifest, manifest.name, None)[0] for manifest in read_campaign(campaign).transfers]


def _fit(prepared: list[Prepared], **choices: object) -> JointFit:
    (found,) = joint_fits(prepared, IdentifySettings(**choices))  # type: ignore[arg-type]
    return found


def test_one_damping_for_each_recording(prepared: list[Prepared]) -> None:
    fit = _fit(prepared, damping="each")
    found = fit.identification
    names = [f"damping_z: {item.measured.name}" for item in prepared]
    assert list(found.names) == ["stiffness_z", *names, "internal_mass"]
    values = [found.value(name) for name in names]
    assert values == pytest.approx([DAMPING] * 2, rel=0.01)
    vector, covariance = mechanics(fit)
    assert vector[1] == pytest.approx(np.mean(values))
    assert covariance[1, 1] > np.var(values, ddof=1)


def test_one_load_takes_the_internal_mass_as_stated(prepared: list[Prepared]) -> None:
    fit = _fit(prepared[:1])
    assert not fit.mass_is_free
    found = fit.identification["internal_mass"]
    assert abs(found.value - 0.769) < 3.0 * 0.002
    assert found.u == pytest.approx(0.002, rel=1e-3)
    assert "internal_mass as stated" in fit.identification.budget
    assert fit.identification.value("stiffness_z") == pytest.approx(STIFFNESS, rel=2e-3)


def test_a_mount_that_gives_is_fitted_with_the_sensor(prepared: list[Prepared]) -> None:
    moved = [_on_adapter(item, seed) for seed, item in enumerate(prepared)]
    fit = _fit(moved, model="adapter")
    found, sensor = fit.identification, fit.identification["stiffness_z"]
    assert abs(sensor.value - 6e8) < 4.0 * sensor.u
    assert abs(found.value("stiffness_z_adapter") - 2e9) < 4.0 * found.u("stiffness_z_adapter")
    assert fit.reason == "as wanted"
    model = modelled(fit, None, prepared[0].manifest.rig.sensor).model
    assert (model.stiffness, model.chain.kind, model.unit) == (sensor.value, "none", "(V/V)/N")


def _on_adapter(item: Prepared, seed: int) -> Prepared:
    """The same recording of a load whose sensor stands on an adapter of 5 kg that gives, exact but for the noise."""
    rng, ratio = np.random.default_rng(seed), item.measured.ratio
    masses, springs, dampers = np.array([5.0, item.load_kg + 0.769]), np.array([2e9, 6e8]), np.array([6e3, 1.5e3])
    chain = MassChain(("adapter", "sensor"), masses, springs, dampers)
    value = chain.transfer(ratio.frequency_hz, "sensor").value
    parts = np.linalg.cholesky(ratio.covariance) @ rng.standard_normal((len(value), 2, 1))
    noisy = value + parts[:, :1, 0] + 1j * parts[:, 1:, 0]
    return replace(item, measured=replace(item.measured, ratio=replace(ratio, value=noisy)))


def test_an_internal_mass_below_zero_leaves_a_model_without_one(prepared: list[Prepared]) -> None:
    fit = _fit([_stiffer(item, 0.985) for item in prepared[:1]] + [_stiffer(prepared[1], 1.0)])
    assert fit.identification.value("internal_mass") < 0.0
    assert any("below zero" in notice.text for notice in fit.identification.notices)
    found = modelled(fit, None, None)
    assert found.model.internal_mass == 0.0
    assert (found.model.sensitivity, found.model.unit) == (1.0, "1/N")


def _stiffer(item: Prepared, factor: float) -> Prepared:
    """The same recording with a load whose mass, times a factor, moves without any internal mass."""
    ratio = item.measured.ratio
    chain = MassChain(("sensor",), np.array([item.load_kg * factor]), np.array([STIFFNESS]), np.array([DAMPING]))
    value = chain.transfer(ratio.frequency_hz, "sensor").value
    return replace(item, measured=replace(item.measured, ratio=replace(ratio, value=value)))


def test_what_is_stated_and_not_used_is_said(spoiled: Path) -> None:
    _change(spoiled / RIG, "[load]", "[load]\nelastic_frequency = 3000.0")
    (manifest,) = read_campaign(spoiled / "chirp-9kg").transfers
    _, notices = prepare(manifest, "chirp", None)
    assert [notice.where for notice in notices if "its joint is stated" in notice.text] == ["chirp"]


def test_two_axes_have_a_result_each(prepared: list[Prepared]) -> None:
    along_x = replace(prepared[0].measured, name="x", drive=np.eye(6)[0], base=_facing_x, tops=(_facing_x,))
    fits = joint_fits([*prepared, replace(prepared[0], measured=along_x)], IdentifySettings(internal_mass="stated"))
    assert [(fit.axis, len(fit.prepared)) for fit in fits] == [("x", 1), ("z", 2)]
    assert "stiffness_x" in fits[0].identification.names


def test_a_second_peak_calls_for_pitching(tmp_path: Path) -> None:
    stand = replace(pitching.PITCHING_STAND, chirp=replace(QUICK, period_s=0.32))
    folder = write_campaign(tmp_path / "campaign", stand)
    found = [prepare(manifest, manifest.name, None)[0] for manifest in read_campaign(folder).transfers]
    fit = _fit(found)
    assert fit.model == "pitching"
    assert fit.reason.startswith("the curves have peaks at 1190.")
    assert fit.identification.value("stiffness_x") == pytest.approx(stand.stiffness[0], rel=2e-3)
    assert fit.identification.value("stiffness_ry") == pytest.approx(stand.stiffness[1], rel=2e-3)
    near = [replace(item, measured=_lines(item.measured, 1100.0, 1300.0)) for item in found[:1]]
    alone = _fit(near, model="translation")
    assert any("--model adapter or pitching" in notice.text for notice in alone.notices)


def _lines(measured: MeasuredTransfer, low_hz: float, high_hz: float) -> MeasuredTransfer:
    """The lines between two frequencies."""
    chosen = (measured.ratio.frequency_hz > low_hz) & (measured.ratio.frequency_hz < high_hz)
    errors = tuple(RelativeError(error.name, error.relative[chosen]) for error in measured.errors)
    return replace(measured, ratio=measured.ratio.at_lines(chosen), errors=errors)


def _change(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def _without_table(path: Path, name: str) -> None:
    """Take a table out of a TOML file."""
    text = path.read_text(encoding="utf-8")
    start = text.index(f"[{name}]")
    end = text.find("\n[", start + 1)
    path.write_text(text[:start] + (text[end + 1 :] if end > 0 else ""), encoding="utf-8")


def _refused(campaign: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """Run the command and return the one sentence that it says."""
    assert main(["identify", str(campaign), "-q", *options]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1, told
    assert not (campaign / "identify").exists()
    return told[0]


CHIRP, RIG = "chirp-9kg/recording.toml", "rig-9kg.toml"
CASES = [
    (CHIRP, 'response = ["top"]', 'response = ["base_too"]', "excitation.response", "base_too"),
    (CHIRP, 'reference = ["base"]', 'reference = ["top"]', "excitation.reference", 'with body = "base"'),
    (CHIRP, 'body = "load"', 'body = "base"', "excitation.response", 'with body = "load", found none on the load'),
    (RIG, 'serial = "0815"', 'serial = "0816"', "sensor.serial", "expected the sensor of"),
    (RIG, 'name = "six-component transducer"', 'name = "another"', "sensor.name", '"six-component transducer"'),
]


@pytest.mark.parametrize(("file", "old", "new", "key", "words"), CASES)
def test_a_wrong_file_is_one_sentence(
    spoiled: Path, capsys: pytest.CaptureFixture[str], file: str, old: str, new: str, key: str, words: str
) -> None:
    _change(spoiled / file, old, new)
    told = _refused(spoiled, capsys)
    assert f"{spoiled / file}: {key}: " in told
    assert words in told


def test_a_rig_without_a_load_is_one_sentence(spoiled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _without_table(spoiled / RIG, "load")
    told = _refused(spoiled, capsys)
    assert f"{spoiled / RIG}: load: expected [load] with the mass" in told


def test_one_load_without_a_sensor_is_one_sentence(spoiled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _without_table(spoiled / "rig-4kg.toml", "sensor")
    told = _refused(spoiled / "chirp-4kg", capsys)
    assert "rig-4kg.toml: sensor: expected [sensor] with internal_mass" in told


def test_equal_loads_do_not_free_the_internal_mass(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = _refused(campaign / "chirp-4kg", capsys, "--internal-mass", "free")
    assert "rig-4kg.toml: load.mass: expected load masses that differ" in told
    assert "found 4.236" in told


def test_a_campaign_of_sines_has_no_transfer_functions(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = _refused(campaign / "sine-0200", capsys)
    assert "excitation.kind: expected a recording of the kind chirp, multisine, noise or impact" in told


def test_results_of_other_files_are_refused(spoiled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import h5py

    from fusion.report.provenance import Provenance, write_provenance

    (spoiled / "sine-0200" / "results").mkdir()
    with h5py.File(spoiled / "sine-0200" / "results" / "result.h5", "w") as file:
        write_provenance(file, Provenance({"rig.toml": "0" * 64}, {}, {}, ()))
    told = _refused(spoiled, capsys)
    assert "sine-0200/results/result.h5: expected the results of these very input files" in told


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--band", "9000", "9500"), "a --band that holds lines between 800 and 2400 Hz"),
        (("--band", "900", "800"), "--band: expected two frequencies in Hz, the lower first"),
        (("--model", "pitching"), "a drive along x or y for --model pitching"),
    ],
)
def test_a_wrong_choice_is_one_sentence(
    campaign: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], words: str
) -> None:
    assert words in _refused(campaign, capsys, *options)


@pytest.mark.parametrize(
    "choices",
    [{"model": "rope"}, {"band_hz": (3.0, 2.0)}, {"load_masses_kg": (0.0,)}, {"permitted": 1.0}],
)
def test_settings_that_mean_nothing_are_refused(choices: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(choices))}: expected"):
        IdentifySettings(**choices)  # type: ignore[arg-type]
