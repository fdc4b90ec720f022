"""`shakercal transfer` end to end: simulated recordings against their truth, and recordings that it refuses."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from scipy.stats import binom
from scipy.stats import chi2 as chi_square
from support import AT_ORIGIN, DOCS, block, channel, documented_columns, edit, rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.phasors.phasor_notices import CHANNELS_RESAMPLED
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensor import response_notices as raised
from fusion.sensor.transfer.resonances import find_resonances
from fusion.sensor.transfer.transfer_evaluation import _unstated_scales, evaluate_transfer
from fusion.sensor.transfer.transfer_records import ChannelChain, ReferenceResult, TransferSettings, uncertainty
from fusion.sensor.transfer.transfer_report import TRANSFER, expanded
from fusion.simulate.chirp import Chirp, Oscillator, write_chirp
from fusion.simulate.preset import read_preset
from shaker.frf.chain import ChainResponse

RIG = read_preset(
    Oscillator,
    "chirp",
    chirp=read_preset(Chirp, "chirp.chirp", sample_rate_hz=10240.0, period_s=0.5, periods=5, band_hz=(300.0, 2800.0)),
)
SLOW = read_preset(Oscillator, "chirp", frequency_hz=400.0, damping_ratio=0.01)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small chirp recording with its truth."""
    return write_chirp(tmp_path_factory.mktemp("chirp"), 3, RIG)


@pytest.fixture
def recording(simulated: Path, tmp_path: Path) -> Path:
    """A copy of the recording that a test may spoil."""
    shutil.copytree(simulated.parent, tmp_path / "campaign")
    return tmp_path / "campaign" / simulated.name


def _evaluated(folder: Path, **choices: object) -> ReferenceResult:
    settings = TransferSettings(**choices)
    return evaluate_transfer(load_manifest(folder), settings, {}).references[0]


def _joint_chi2(result: ReferenceResult, true: np.ndarray) -> tuple[float, np.ndarray]:
    """χ² of all lines together with the common errors as unknowns of unit variance, and those unknowns."""
    ratio = result.transfer.ratio
    rows, columns = [], []
    for k, spread in enumerate(result.random_covariance):
        whiten = np.linalg.inv(np.linalg.cholesky(spread))
        deviation = ratio.value[k, 0] - true[k]
        rows.append(whiten @ [deviation.real, deviation.imag])
        effects = true[k] * np.array([error.relative[k, 0] for error in result.errors])
        columns.append(whiten @ np.stack([effects.real, effects.imag]))
    y, design = np.concatenate(rows), np.concatenate(columns)
    unknown = np.linalg.solve(design.T @ design + np.eye(design.shape[1]), design.T @ y)
    return float(np.sum((y - design @ unknown) ** 2) + np.sum(unknown**2)), unknown


def test_the_truth_is_an_oscillator_on_its_base(simulated):
    """ẍ of m ẍ + b (ẋ - ẋ_base) + k (x - x_base) = 0 over that of the base, by its magnitude and phase."""
    truth = json.loads((simulated / "truth.json").read_text())
    r = np.array(truth["frequency_hz"]) / 1477.35
    coupling = r / 66.0  # 2 ζ r, a quality of 66
    transfer = np.array(truth["transfer"]["re"]) + 1j * np.array(truth["transfer"]["im"])
    magnitude = np.sqrt((1.0 + coupling**2) / ((1.0 - r**2) ** 2 + coupling**2))
    np.testing.assert_allclose(np.abs(transfer), magnitude, rtol=1e-10)
    np.testing.assert_allclose(np.angle(transfer), np.arctan(coupling) - np.arctan2(coupling, 1.0 - r**2), atol=1e-10)
    assert truth["drawn"]["amplifier.corner"] != [0.0]


def test_the_curve_is_the_truth_within_its_covariance(simulated):
    result = _evaluated(simulated)
    frequency = result.transfer.ratio.frequency_hz
    truth = json.loads((simulated / "truth.json").read_text())
    np.testing.assert_allclose(frequency, truth["frequency_hz"], rtol=1e-7)
    true = np.array(truth["transfer"]["re"]) + 1j * np.array(truth["transfer"]["im"])
    chi2, unknown = _joint_chi2(result, true)
    freedom = 2 * len(frequency)
    # The covariance of a line is itself an estimate of some 40 degrees of freedom, hence the wider limits.
    assert 0.85 * freedom < chi2 < 1.2 * freedom
    assert np.all(np.abs(unknown) < 3.5)
    names = {"base: scale", "base: delay", "top: scale", "top: delay", "top: frequency of amplifier"}
    assert {error.name for error in result.errors} == names


@pytest.mark.parametrize("stated", [0.0, 1.0])
def test_u_of_a_line_covers_with_noise_of_few_degrees_of_freedom(simulated, stated):
    """95 % of magnitudes and of phases, with noise of 4 degrees of freedom alone and with a stated error as large."""
    result, rng = _evaluated(simulated), np.random.default_rng(2)
    ratio = result.transfer.ratio
    count, u = len(ratio.frequency_hz), 1e-3
    noise = u**2 * (rng.chisquare(4, count) / 4.0)[:, None, None] * np.eye(2)
    off = u * np.hypot(1.0, stated) * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    drawn = replace(
        ratio,
        value=(np.exp(0.4j) * (1.0 + off))[:, None],
        covariance=noise + (stated * u) ** 2 * np.eye(2),
        dof=np.full(count, 4.0),
    )
    one = replace(result, transfer=replace(result.transfer, ratio=drawn), random_covariance=noise)
    covered = [np.mean(np.abs(part) < U) for part, U in zip((off.real, off.imag), expanded(one, 0), strict=True)]
    plain = [np.mean(np.abs(part) < 2.0 * size) for part, size in zip((off.real, off.imag), _u(one), strict=True)]
    low, high = binom.ppf([1e-3, 0.999], count, 0.95) / count
    assert all(low <= share <= high for share in covered)
    assert stated or max(plain) < low  # k = 2 leaves out one line in nine


def _u(result: ReferenceResult) -> tuple[np.ndarray, np.ndarray]:
    """Standard uncertainties of magnitude, relative, and phase."""
    ratio = result.transfer.ratio
    return uncertainty(ratio.value[:, 0], ratio.covariance)


def test_the_resonance_is_found(simulated):
    (found,) = _evaluated(simulated).resonances
    assert abs(found.fit.frequency_hz - RIG.frequency_hz) < 3.0 * found.u_frequency_hz
    assert abs(found.fit.damping_ratio - RIG.damping_ratio) < 3.0 * found.u_damping_ratio
    assert abs(found.fit.frequency_hz / RIG.frequency_hz - 1.0) < 5e-5
    assert abs(found.fit.damping_ratio / RIG.damping_ratio - 1.0) < 0.01
    assert found.fit.kind == "transmissibility"
    assert found.budget["rate of the clock"][0] == pytest.approx(1e-6 * found.fit.frequency_hz)
    averaged = _evaluated(simulated, estimator="H1", resolution_hz=8.0).transfer
    assert (averaged.estimator, averaged.line_spacing_hz) == ("H1", pytest.approx(8.0))


def test_every_peak_of_a_curve_is_a_separate_resonance(simulated, tmp_path):
    evaluation = evaluate_transfer(load_manifest(simulated), TransferSettings(), {})
    (result,) = evaluation.references
    frequency = result.transfer.ratio.frequency_hz
    true = ((700.0, 0.004), (1450.0, 0.01), (2500.0, 0.006))
    rigs = [read_preset(Oscillator, "chirp", frequency_hz=f, damping_ratio=z) for f, z in true]
    value = np.sum([rig.transmissibility(frequency) for rig in rigs], axis=0)[:, None]
    noise = np.random.default_rng(5).standard_normal((2, len(frequency))) * 1e-3
    ratio = replace(
        result.transfer.ratio,
        value=value + (noise[0] + 1j * noise[1])[:, None],
        covariance=np.tile(1e-6 * np.eye(2), (len(frequency), 1, 1)),
    )
    found, _, notices = find_resonances(replace(result.transfer, ratio=ratio), (), ["transmissibility"], 0.0)
    assert [round(one.fit.frequency_hz) for one in found] == [f for f, _ in true]
    for one, (f, z) in zip(found, true, strict=True):
        assert abs(one.fit.frequency_hz - f) < 5.0 * one.u_frequency_hz
        assert abs(one.fit.damping_ratio - z) < 5.0 * one.u_damping_ratio
        assert one.fit.law == "viscous"
    assert {notice.code for notice in notices} <= {raised.LAW_UNDECIDED.code}
    TRANSFER.write(replace(evaluation, references=(replace(result, resonances=found),)), tmp_path / "out")
    with h5py.File(tmp_path / "out" / "transfer.h5") as file:
        assert len(file["references/base/resonances"]) == 3


@pytest.mark.slow
def test_the_uncertainty_of_a_resonance_covers(tmp_path):
    """Noise, scales, delays, corner and clock drawn anew: deviations over their standard uncertainties."""
    deviations, trials = [], 30
    for seed in range(trials):
        (tmp_path / f"{seed}").mkdir()
        (found,) = _evaluated(write_chirp(tmp_path / f"{seed}", seed, RIG)).resonances
        error = found.fit.frequency_hz - RIG.frequency_hz, found.fit.damping_ratio - RIG.damping_ratio
        deviations.append(np.divide(error, (found.u_frequency_hz, found.u_damping_ratio)))
    spread = np.sqrt(np.mean(np.square(deviations), axis=0))
    low, high = np.sqrt(chi_square.ppf([2.5e-3, 1.0 - 2.5e-3], trials) / trials)
    assert np.all((spread > low) & (spread < high))


def test_files_of_a_run(recording, capsys):
    assert main(["transfer", str(recording)]) == 0
    assert "top / base: 1477.3" in capsys.readouterr().out
    folder = recording / "transfer"
    assert sorted(path.name for path in folder.iterdir()) == ["transfer.csv", "transfer.h5", "transfer.html"]
    found = rows(folder / "transfer.csv")
    assert list(found[0]) == documented_columns("transfer.md", "transfer.csv")
    with h5py.File(folder / "transfer.h5") as file:
        group = file["references/base"]
        value = group["transfer/ratio/value"][:, 0]
        covariance = group["transfer/ratio/covariance"][()]
        assert list(file["provenance/files"].asstr()) == ["transfer.csv", "transfer.html", "transfer.h5"]
        assert len(file["provenance/input_file"]) == 4
    assert len(found) == len(value) == 1251
    np.testing.assert_array_equal([complex(float(row["re"]), float(row["im"])) for row in found], value)
    np.testing.assert_allclose([float(row["u_re"]) ** 2 for row in found], covariance[:, 0, 0], rtol=1e-12)
    head = {(row["response"], row["reference"], row["estimator"], row["unit"]) for row in found}
    assert head == {("top", "base", "periodic", "1")}
    page = (folder / "transfer.html").read_text(encoding="utf-8")
    self_contained(page)
    assert "1477.3" in page


@pytest.mark.usefixtures("no_pages")
def test_results_of_the_same_input_are_replaced_and_others_refused(recording, refused):
    table, run = recording / "transfer" / "transfer.csv", ["transfer", str(recording), "-q"]
    (recording / "transfer").mkdir()
    (recording / "transfer" / "notes.txt").write_text("mine")
    assert f"{recording / 'transfer'}: " in refused(*run)
    assert main([*run, "--force"]) == 0
    assert (recording / "transfer" / "notes.txt").read_text() == "mine"
    first = table.read_bytes()
    (recording / "amplifier.toml").write_text("[[element]]\nfilter = 'bessel'\norder = 2\ncorner = 3e4\n")
    assert main(run) == 0
    assert table.read_bytes() != first
    (recording / "accelerometers.h5").rename(recording / "other.h5")
    edit(recording / "recording.toml", "accelerometers.h5", "other.h5")
    assert f"{recording / 'transfer'}: " in refused(*run)


@pytest.mark.usefixtures("no_pages")
def test_every_recording_of_a_campaign_gets_a_folder(recording, tmp_path):
    shutil.copytree(recording, recording.parent / "again")
    assert main(["transfer", str(recording.parent), "-o", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["again", "chirp"]


def test_repeated_mounting_is_included_in_u_of_a_resonance(recording):
    plain = _evaluated(recording).resonances[0]
    with (recording.parent / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write("\n[model.mounting]\nfrequency_uncertainty = 2e-3\ndamping_ratio_uncertainty = 0.1\n")
    wide = _evaluated(recording).resonances[0]
    hertz, damping = plain.fit.frequency_hz, plain.fit.damping_ratio
    assert wide.u_frequency_hz == pytest.approx(np.hypot(plain.u_frequency_hz, 2e-3 * hertz))
    assert wide.u_damping_ratio == pytest.approx(np.hypot(plain.u_damping_ratio, 0.1 * damping))
    assert wide.budget["mounting anew"] == pytest.approx((2e-3 * hertz, 0.1 * damping))


def test_a_quantity_turns_response_and_reference(recording):
    top = 'name = "top"\nquantity = "{}"'
    edit(recording / "recording.toml", top.format("acceleration"), top.format("velocity"))
    mixed = _evaluated(recording)
    assert mixed.transfer.ratio.unit == ("(m/s)/(m/s^2)",)
    same = _evaluated(recording, quantity="displacement")
    assert same.transfer.ratio.unit == ("1",)
    omega = 2.0 * np.pi * same.transfer.ratio.frequency_hz
    np.testing.assert_allclose(same.transfer.ratio.value, mixed.transfer.ratio.value * 1j * omega[:, None])


@pytest.mark.parametrize(("u", "keys", "unstated"), [(0.002, {}, []), (0.0, {}, ["a"]), (0.0, {"common": "x"}, [])])
def test_a_scale_is_stated_by_the_table_of_a_response_too(u, keys, unstated):
    lines = np.array([100.0])
    response = ChainResponse(np.ones(1, complex), np.array([[u + 0j]]), ("magnitude of the table",))
    entry = ChannelEntry(name="a", quantity="voltage", **keys)
    found = _unstated_scales([ChannelChain(entry, lines, response, "daq", 0.0)])
    assert [notice.values["channels"] for notice in found] == unstated


def test_what_channels_share_cancels(recording):
    edit(recording / "recording.toml", "scale = 100.0", 'scale = 100.0\ncommon = "amplifier"')
    names = {error.name for error in _evaluated(recording).errors}
    assert names == {"amplifier: frequency of amplifier"}


@pytest.mark.parametrize(
    ("read", "quantity", "kind", "unit"),
    [
        ("acceleration", "displacement", "receptance", "m/N"),
        ("angular_velocity", None, "mobility", "(rad/s)/N"),
        ("angular_velocity", "acceleration", "accelerance", "(rad/s^2)/N"),
    ],
)
def test_blows_on_a_mass_give_its_receptance_and_what_follows_from_it(tmp_path, read, quantity, kind, unit):
    rate, mass, rng = 10240.0, 0.5, np.random.default_rng(2)
    force = np.zeros(round(8.0 * rate))
    pulse = np.sin(np.pi * np.arange(1, 10) / 10.0) ** 2
    for hit in range(7):
        start = round((0.3 + 1.1 * hit + 0.01 * rng.random()) * rate)
        force[start : start + len(pulse)] += 100.0 * (1.0 + 0.2 * rng.random()) * pulse
    rig = read_preset(Oscillator, "chirp", frequency_hz=640.0, damping_ratio=0.01)
    frequency = np.fft.rfftfreq(2 * len(force), 1.0 / rate)
    p = 1j * frequency / rig.frequency_hz
    stiffness = mass * (2.0 * np.pi * rig.frequency_hz) ** 2
    receptance = 1.0 / (1.0 + 2.0 * rig.damping_ratio * p + p * p) / stiffness
    response = receptance * (2j * np.pi * frequency) ** (2 + TRANSDUCERS[read].order)
    top = np.fft.irfft(np.fft.rfft(force, 2 * len(force)) * response)[: len(force)]
    folder = _blow_recording(tmp_path, rate, force, top, rng)
    edit(folder / "recording.toml", '"acceleration"', f'"{read}"')
    result = _evaluated(folder, quantity=quantity)
    assert result.transfer.ratio.unit == (unit,)
    (found,) = result.resonances
    assert found.fit.kind == kind
    assert abs(found.fit.frequency_hz - rig.frequency_hz) < 4.0 * found.u_frequency_hz
    assert abs(found.fit.damping_ratio - rig.damping_ratio) < 4.0 * found.u_damping_ratio
    assert found.fit.gain.real * stiffness == pytest.approx(1.0, rel=0.01)


def _blow_recording(folder: Path, rate: float, force: np.ndarray, top: np.ndarray, rng: np.random.Generator) -> Path:
    """Write a recording of blows with a little noise on both channels."""
    with h5py.File(folder / "daq.h5", "w") as file:
        for name, values in (("hammer", force), ("top", top)):
            file[name] = values + 2e-4 * np.abs(values).max() * rng.standard_normal(len(values))
            file[name].attrs["sample_rate"] = rate
    (folder / "rig.toml").write_text('format = 1\nname = "mass on a spring"\n')
    impact = {"kind": "impact", "direction": [0, 0, 1], "band": [100.0, 1500.0], "reference": ["hammer"]}
    text = block(format=1, name="blows", rig="rig.toml") + block("excitation", **impact)
    text += block("[daq]", name="daq", file="daq.h5") + channel("hammer", "force", scale_uncertainty=1e-3)
    text += channel("top", "acceleration", body="load", **AT_ORIGIN, scale_uncertainty=1e-3)
    (folder / "recording.toml").write_text(text)
    return folder


def _two_clocks(folder: Path, rates: tuple[float, float]) -> Path:
    """Write a periodic recording whose reference and response are in two blocks with separate clocks.

    The second starts 37 ms later and runs 170 ppm fast; pulses at 53 Hz in both tie them.
    """
    rng = np.random.default_rng(8)
    period, length_s, start = 0.25, 3.0, (0.0, 0.0371)
    frequency = np.arange(25, 201) / period
    drive = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, len(frequency)))
    h = SLOW.transmissibility(frequency)
    pulses = 0.2 + np.arange(120) / 53.0
    blocks = ""
    for number, (name, value, rate) in enumerate((("base", drive, rates[0]), ("top", drive * h, rates[1]))):
        clock = 1.0 - 170e-6 * number  # true seconds in one of this clock
        time = start[number] + clock * np.arange(round((length_s - start[number]) * rate)) / rate
        signal = sum((v * np.exp(2j * np.pi * f * time)).real for v, f in zip(value, frequency, strict=True))
        last = np.clip(np.searchsorted(pulses, time, side="right") - 1, 0, None)
        trigger = np.where((time >= pulses[last]) & (time < pulses[last] + 5e-3), 5.0, 0.0)
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file.attrs["sample_rate"] = rate
            file[name] = signal + 0.02 * rng.standard_normal(len(time))
            file["pulses"] = trigger
        blocks += block("[daq]", name=f"{name} box", file=f"{name}.h5")
        blocks += channel(name, "acceleration", body="load", **AT_ORIGIN, scale_uncertainty=1e-4)
        blocks += channel("pulses", "trigger")
    (folder / "rig.toml").write_text('format = 1\nname = "two clocks"\n')
    multisine = {"kind": "multisine", "direction": [0, 0, 1], "band": [100.0, 800.0], "period": period}
    head = block(format=1, name="two", rig="rig.toml") + block("excitation", **multisine, reference=["base"])
    (folder / "recording.toml").write_text(head + blocks)
    return folder


@pytest.mark.parametrize("rates", [(2048.0, 2560.0), (2560.0, 2560.0)])
def test_channels_of_two_clocks_are_read_on_one(tmp_path, rates):
    folder = _two_clocks(tmp_path, rates)
    evaluation = evaluate_transfer(load_manifest(folder), TransferSettings(), {})
    (result,) = evaluation.references
    assert len(evaluation.clocks) == 2
    assert CHANNELS_RESAMPLED.code in {notice.code for notice in evaluation.notices}
    frequency = result.transfer.ratio.frequency_hz
    assert len(frequency) == 176
    true = SLOW.transmissibility(frequency)
    chi2, unknown = _joint_chi2(result, true)
    assert chi2 < 1.2 * 2 * len(frequency)  # less, where the clocks' rates are known less well than the samples
    assert np.all(np.abs(unknown) < 3.5)
    late = 1.0 + np.stack([error.relative[:, 0] for error in result.errors], axis=1) @ unknown
    np.testing.assert_allclose(result.transfer.ratio.value[:, 0] / (true * late), 1.0, atol=5e-3)
    assert "clock top box" in {error.name for error in result.errors}
    (found,) = result.resonances
    assert abs(found.fit.frequency_hz - SLOW.frequency_hz) < 4.0 * found.u_frequency_hz


def test_blocks_without_a_common_trigger_are_refused(tmp_path):
    folder = _two_clocks(tmp_path, (2048.0, 2048.0))
    text = (folder / "recording.toml").read_text()
    end = text.rindex('[[daq.channel]]\nname = "pulses"')
    (folder / "recording.toml").write_text(text[:end])
    with pytest.raises(InputError) as caught:
        _evaluated(folder)
    assert caught.value.file == folder / "recording.toml"
    assert "base box" in str(caught.value)


CASES = [  # file, its old and new text, the key of the refusal, its code where this command declares it
    ("recording.toml", 'kind = "chirp"', 'kind = "noise"', "excitation.period", ""),
    ("recording.toml", 'reference = ["base"]\n', "", "excitation.reference", raised.MISSING_TRANSFER_ENTRY.code),
    ("recording.toml", 'reference = ["base"]', 'reference = ["nobody"]', "excitation.reference", ""),
    (
        "recording.toml",
        'response = ["top"]',
        'response = ["base"]',
        "excitation.response",
        raised.WRONG_CHANNEL_NAME.code,
    ),
    ("recording.toml", "period = 0.5", "period = 0.4", "excitation.period", raised.PERIOD_WITHOUT_SIGNAL.code),
    ("recording.toml", "period = 0.5", "period = 5.0", "excitation.period", ""),
    ("recording.toml", "settle_periods = 1", "settle_periods = 4", "excitation.period", ""),
    ("recording.toml", "band = [300.0, 2800.0]", "band = [6000.0, 8000.0]", "excitation.band", ""),
    ("amplifier.toml", "order = 4", "order = 0", "element.amplifier.order", ""),
    ("amplifier.toml", "corner", "poles = [[-1.0, 2.0]]\ncorner", "element.amplifier.poles", ""),
]


@pytest.mark.parametrize(("file", "old", "new", "key", "code"), CASES)
def test_a_wrong_recording_is_one_sentence(recording, refused, file, old, new, key, code):
    edit(recording / file, old, new)
    refusal = refused("transfer", recording, "-q")
    assert f"{code} " in refusal
    assert f"{recording / file}: {key}: " in refusal
    assert not (recording / "transfer").exists()


def test_a_response_that_ends_below_the_band_and_a_line_spacing_too_fine_for_the_record(recording, refused):
    assert "--resolution: " in refused("transfer", recording, "--estimator", "H1", "--resolution", "0.1", "-q")
    table = "frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad\n10,1,0,0,0\n1000,1,0,0,0\n"
    (recording / "table.csv").write_text(table)
    edit(recording / "recording.toml", "amplifier.toml", "table.csv")
    with pytest.raises(InputError, match=r"100\d") as caught:
        _evaluated(recording)
    assert (caught.value.file.name, caught.value.key) == ("table.csv", "frequency_hz")


def test_the_example_of_the_guide_is_a_recording(recording):
    guide = (DOCS / "transfer.md").read_text(encoding="utf-8")
    example, _ = re.findall(r"^```toml\n(.*?)^```", guide, re.DOTALL | re.MULTILINE)
    (recording / "recording.toml").write_text(example.replace("period = 1.0", "period = 0.5"), encoding="utf-8")
    assert len(_evaluated(recording).resonances) == 1
