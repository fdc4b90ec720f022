"""One signal through the manifest in every file format that a laboratory may have: equal phasors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyuff
import scipy.io
from nptdms import ChannelObject, TdmsWriter
from support import AT_ORIGIN, channel, evaluated, write_daq

from fusion.errors import InputError
from fusion.sensitivity.analyse import Evaluation
from shaker.signal_notices import HARMONICS_ON_ALIAS

RATE_HZ, SAMPLES, FREQUENCY_HZ, PHASOR = 4096.0, 4096, 100.01, 0.6 * np.exp(1.1j)
GRAVITY = 9.80665
Signals = dict[str, np.ndarray]


def _tdms(path: Path, signals: Signals) -> None:
    properties = {"wf_increment": 1.0 / RATE_HZ, "wf_start_offset": 0.0}
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([ChannelObject("daq", name, s, properties=properties) for name, s in signals.items()])


def _uff(path: Path, signals: Signals) -> None:
    for node, (name, samples) in enumerate(signals.items(), 1):
        data = pyuff.prepare_58(
            binary=1, func_type=1, rsp_node=node, rsp_dir=3, ref_node=0, ref_dir=0, id1="a", rsp_ent_name=name,
            ref_ent_name="NONE", ordinate_axis_units_lab="V", abscissa_spacing=1, abscissa_min=0.0,
            abscissa_inc=1.0 / RATE_HZ, num_pts=SAMPLES, ord_data_type=4, data=samples,
            x=np.arange(SAMPLES) / RATE_HZ, abscissa_spec_data_type=17, ordinate_spec_data_type=11,
            orddenom_spec_data_type=0, z_axis_spec_data_type=0, z_axis_value=0.0,
        )  # fmt: skip
        pyuff.UFF(str(path)).write_sets([data], "add")


def _wav(path: Path, signals: Signals) -> None:
    scipy.io.wavfile.write(path, int(RATE_HZ), np.stack(list(signals.values()), axis=1))


def _csv(path: Path, signals: Signals) -> None:
    columns = np.column_stack([np.arange(SAMPLES) / RATE_HZ, *signals.values()])
    np.savetxt(path, columns, delimiter=",", header=",".join(["time", *signals]), comments="", fmt="%.12g")


def _lvm(path: Path, signals: Signals) -> None:
    head = ["LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,"]
    head += ["X_Columns\tOne", "***End_of_Header***\t", "\t"]
    part = [f"Channels\t{len(signals)}", f"Samples\t{SAMPLES}\t{SAMPLES}", "X0\t0,0\t0,0"]
    part += [f"Delta_X\t{1 / RATE_HZ:.12g}\t{1 / RATE_HZ:.12g}".replace(".", ","), "***End_of_Header***\t"]
    titles = "\t".join(["X_Value", *signals, "Comment"])
    rows = np.column_stack([np.arange(SAMPLES) / RATE_HZ, *signals.values()])
    text = ["\t".join(f"{value:.12g}".replace(".", ",") for value in row) for row in rows]
    path.write_text("\n".join([*head, *part, titles, *text]) + "\n", encoding="latin-1")


# Suffix → writer and what the format needs in the manifest's block: channel names, rate.
def _mf4(path: Path, signals: Signals) -> None:
    asammdf = pytest.importorskip("asammdf")
    time_s = np.arange(SAMPLES) / RATE_HZ
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(samples, time_s, name=name, unit="V") for name, samples in signals.items()])
        file.save(path, overwrite=True)


def _parquet(path: Path, signals: Signals) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    columns = {"time": np.arange(SAMPLES) / RATE_HZ} | signals
    pytest.importorskip("pyarrow.parquet").write_table(pyarrow.table(columns), path)


FORMATS: dict[str, tuple[Callable[[Path, Signals], None], tuple[str, str], bool]] = {
    "h5": (lambda path, signals: write_daq(path, RATE_HZ, signals), ("a", "b"), False),
    "tdms": (_tdms, ("daq/a", "b"), False),
    "uff": (_uff, ("a", "b"), False),
    "mat": (scipy.io.savemat, ("a", "b"), True),
    "wav": (_wav, ("1", "2"), False),
    "csv": (_csv, ("a", "b"), False),
    "lvm": (_lvm, ("a", "b"), False),
    "mf4": (_mf4, ("0/a", "b"), False),
    "parquet": (_parquet, ("a", "b"), False),
}


def acceleration(name: str, body: str = "load", scale: float = 1.0) -> str:
    return channel(name, "acceleration", body=body, **AT_ORIGIN, scale=scale, scale_uncertainty=1e-3)


def evaluate(folder: Path, frequencies: str, daq: str) -> Evaluation:
    """Evaluate one DAQ block on a rig without anything."""
    (folder / "rig.toml").write_text('format = 1\nname = "rig"\n', encoding="utf-8")
    head = f'format = 1\nname = "r"\nrig = "rig.toml"\n[excitation]\nkind = "multisine"\nfrequencies = {frequencies}\n'
    text = f'{head}direction = [0.0, 0.0, 1.0]\n[[daq]]\nname = "daq"\n{daq}'
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    return evaluated(folder)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
@pytest.mark.parametrize("suffix", list(FORMATS))
def test_phasors_are_equal_in_every_format(tmp_path, suffix):
    write, names, needs_rate = FORMATS[suffix]
    time_s = np.arange(SAMPLES) / RATE_HZ
    rng = np.random.default_rng(0)
    wave = (PHASOR * np.exp(2j * np.pi * FREQUENCY_HZ * time_s)).real + 1e-5 * rng.normal(size=SAMPLES)
    write(tmp_path / f"daq.{suffix}", {"a": wave, "b": -0.5 * wave})
    block = f'file = "daq.{suffix}"\n' + (f"sample_rate = {RATE_HZ}\n" if needs_rate else "")
    for name, body in zip(names, ("load", "base"), strict=True):
        block += acceleration(name, body, 10.0)
    evaluation = evaluate(tmp_path, "[100.0]", block)
    assert [channel.name for channel in evaluation.channels] == list(names)
    first, second = (channel.phasors for channel in evaluation.channels)
    # Universal files keep six digits of the sampling interval.
    assert first.frequency_hz[0] == pytest.approx(FREQUENCY_HZ, rel=2e-6 if suffix == "uff" else 1e-7)
    for found, factor in ((first, 10.0), (second, -5.0)):
        assert abs(found.value[0, 0] / (factor * PHASOR) - 1) < 1e-5
    assert {a.body for a in evaluation.accelerations} == {"load", "base"}


@pytest.fixture(scope="module")
def shaker(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Evaluation]:
    """Return a function that evaluates a real shaker's record of three tones, downsampled by a factor, once."""

    @cache
    def of(factor: int) -> Evaluation:
        folder = tmp_path_factory.mktemp("shaker")
        source = data_dir / "shaker_three_tone" / f"data_set_1_downsampled_by_{factor}.lvm"
        (folder / "shaker.lvm").write_bytes(source.read_bytes())
        force = channel("Force", "force", scale=4.4482216)
        drive = channel("Voltage", "voltage")
        top = acceleration("Acceleratio", scale=GRAVITY)
        return evaluate(folder, "[100.0, 120.0, 150.0]", 'file = "shaker.lvm"\n' + top + force + drive)

    return of


def per_pound(evaluation: Evaluation, line: int) -> float:
    """Acceleration in g over force in lb at a line."""
    acceleration, force = (channel.phasors.value[line, 0] for channel in evaluation.channels[:2])
    return float(abs(acceleration / force) * 4.4482216 / GRAVITY)


def test_a_decimated_labview_record_of_a_real_shaker(shaker):
    evaluation = shaker(16)
    lines, voltage = evaluation.lines, evaluation.channels[2].phasors
    tones = np.flatnonzero(lines.multiple == 1)
    np.testing.assert_allclose(voltage.frequency_hz[tones], [99.9999, 119.9999, 149.9999], atol=5e-5)
    np.testing.assert_allclose(np.abs(voltage.value[tones, 0]), 0.4994, atol=5e-5)
    assert np.all(voltage.u_re[tones] < 5e-6)
    assert per_pound(evaluation, tones[2]) == pytest.approx(0.0920, abs=5e-4)
    assert evaluation.channels[0].phasors.unit == ("m/s^2",)
    harmonics = set(zip(lines.nominal_hz.tolist(), lines.multiple.tolist(), strict=True))
    assert {(100.0, 2), (120.0, 2), (150.0, 2), (120.0, 4), (120.0, 6)} <= harmonics
    assert any("2·99.9999 + 120 Hz" in str(notice.values.get("lines")) for notice in lines.notices)


def test_an_undersampled_record_of_a_real_shaker(shaker):
    """At 200 samples per second the 150 Hz tone is taken at its alias, 50 Hz; 100 Hz is the Nyquist frequency."""
    evaluation = shaker(256)
    tones = np.flatnonzero(evaluation.lines.multiple == 1)
    np.testing.assert_allclose(evaluation.lines.frequency_hz[tones], [119.9999, 149.9999], atol=5e-5)
    np.testing.assert_allclose(np.abs(evaluation.channels[2].phasors.value[tones, 0]), 0.4994, atol=2e-4)
    full = shaker(16)
    fast = np.flatnonzero(full.lines.multiple == 1)
    assert per_pound(evaluation, tones[1]) == pytest.approx(per_pound(full, fast[2]), rel=0.05)
    # The 4th and 6th harmonic of 120 Hz are strong in this record, and nothing kept them out of the decimated file.
    assert 0.12 < 1.0 - per_pound(evaluation, tones[0]) / per_pound(full, fast[1]) < 0.22
    (mixed,) = [notice for notice in evaluation.lines.notices if notice.where == "120 Hz"]
    assert (mixed.code, mixed.values["alias_hz"]) == (HARMONICS_ON_ALIAS.code, pytest.approx(80.0, abs=1e-3))
    assert "480 Hz (4 × 120 Hz), 720 Hz (6 × 120 Hz)" in mixed.values["harmonics"]
    (dropped,) = [notice for notice in evaluation.lines.notices if notice.where == "100 Hz"]
    assert dropped.values["neighbour"] == "the Nyquist frequency"


def test_a_channel_too_slow_for_every_line_is_named(tmp_path):
    wave = np.sin(2 * np.pi * FREQUENCY_HZ * np.arange(SAMPLES) / RATE_HZ)
    wave = wave + 1e-3 * np.random.default_rng(0).normal(size=SAMPLES)
    with h5py.File(tmp_path / "daq.h5", "w") as file:
        for name, step in (("fast", 1), ("slow", 64)):
            file[name] = wave[::step]
            file[name].attrs["sample_rate"] = RATE_HZ / step
    block = 'file = "daq.h5"\n' + acceleration("fast")
    with pytest.raises(InputError, match=r"slow: .* 200"):
        evaluate(tmp_path, "[100.0]", block + channel("slow", "voltage"))
