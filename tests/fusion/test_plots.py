"""Figures: what is drawn lies where the data are; the vector graphics are well formed and repeatable."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from evaluation_factory import FREQUENCY_HZ, Choice, make_evaluation

from fusion.report.motion_figures import beat_curve, camera_rate_hz, folded_curve, main_frequency, residual_spectrum
from fusion.report.recording import draw_all
from fusion.report.signal_figures import draw_trigger
from fusion.report.style import padded, power_text, thin_out
from fusion.sensitivity.analyse import Evaluation

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return make_evaluation(tmp_path_factory.mktemp("Fz"))


def test_every_figure_is_well_formed_and_asks_for_nothing_outside(evaluation: Evaluation) -> None:
    pictures = [picture for group in draw_all(evaluation).values() for picture in group]
    assert len({picture.name for picture in pictures}) == len(pictures) >= 13
    for picture in pictures:
        root = ElementTree.fromstring(picture.svg)
        assert root.tag == f"{SVG}svg"
        assert not list(root.iter(f"{SVG}text")), "text must be drawn as paths"
        for image in root.iter(f"{SVG}image"):
            assert image.attrib["{http://www.w3.org/1999/xlink}href"].startswith("data:image/png;base64,")
        assert picture.title
        assert picture.caption.endswith(".")


def test_a_figure_is_the_same_each_time(evaluation: Evaluation) -> None:
    clocks = evaluation.clocks
    assert draw_trigger(clocks).svg == draw_trigger(clocks).svg


def test_beat_curve_passes_through_the_fit_at_every_frame(evaluation: Evaluation) -> None:
    stereo = evaluation.stereo[0]
    assert np.allclose(beat_curve(stereo, stereo.time_s), stereo.fit.model(stereo.time_s), rtol=0, atol=1e-11)


def test_beat_curve_is_slow(evaluation: Evaluation) -> None:
    stereo = evaluation.stereo[0]
    fine = np.linspace(stereo.time_s[0], stereo.time_s[-1], 4000)
    z = beat_curve(stereo, fine)[:, 2]
    crossings = np.count_nonzero(np.diff(np.sign(z)))
    assert crossings == 4  # 106.25 Hz - 2 × 52.874 Hz = 0.502 Hz: two periods in 3.97 s


def test_folded_curve_is_the_model_without_its_offset(evaluation: Evaluation) -> None:
    stereo = evaluation.stereo[0]
    frequency = main_frequency(stereo)
    assert frequency == FREQUENCY_HZ[0]
    phase = np.mod(stereo.time_s * frequency, 1.0)
    model = stereo.fit.model(stereo.time_s) - stereo.fit.offset
    # The factory's harmonics are 0.6 mHz off the multiples, 2e-5 periods per second.
    assert np.allclose(folded_curve(stereo, frequency, phase)[:, 2], model[:, 2], rtol=0, atol=5e-9)


def test_camera_rate_counts_missing_frames(tmp_path: Path) -> None:
    evaluation = make_evaluation(tmp_path, Choice(frames=100))
    assert camera_rate_hz(evaluation.stereo[0]) == pytest.approx(52.874)


def test_residual_spectrum_shows_the_amplitude_of_what_was_not_fitted(evaluation: Evaluation) -> None:
    stereo = evaluation.stereo[0]
    rate = camera_rate_hz(stereo)
    bins = 40 * rate / len(stereo.time_s)
    stereo.residual[:, 0] += 2e-6 * np.cos(2.0 * np.pi * bins * (stereo.time_s - stereo.time_s[0]))
    frequency, amplitude = residual_spectrum(stereo)
    peak = int(np.argmax(amplitude[:, 0]))
    assert frequency[peak] == pytest.approx(bins)
    assert amplitude[peak, 0] == pytest.approx(2e-6, rel=0.05)


def test_thinning_keeps_peaks() -> None:
    x = np.arange(1.0, 1001.0)
    y = np.ones(1000)
    y[512] = 9.0
    few_x, few_y = thin_out(x, y, np.geomspace(1.0, 1001.0, 50))
    assert len(few_x) < 60
    assert few_y.max() == 9.0
    assert few_x[np.argmax(few_y)] == 513.0
    assert np.all(np.diff(few_x) > 0.0)


def test_small_helpers() -> None:
    assert padded(0.0, 10.0, 0.1) == (-1.0, 11.0)
    assert padded(2.0, 2.0)[0] < 2.0 < padded(2.0, 2.0)[1]
    assert power_text(-7) == "10⁻⁷"


def test_recording_without_cameras_and_sensor_has_the_figures_it_can_have(tmp_path: Path) -> None:
    pictures = draw_all(make_evaluation(tmp_path, Choice(sensor=False, images=False)))
    assert not pictures["sensitivity"]
    assert not pictures["motion"]
    assert not pictures["budget"]
    assert pictures["channels"]
