"""Inputs of a result: other libraries recompute its uncertainty, shares add up, certificates are named."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import GTC
import numpy as np
import pytest
from scipy.stats import t
from support import refusals, rows

from fusion.cli import main
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.report.traceability import largest_of, trace_inputs, traceability
from fusion.sensitivity.input_evidence import InputEvidence

VALUE = np.array([[3.0 + 4.0j]])


def _uncertainty() -> Uncertainty:
    """Noise of 1 % of the magnitude alone, a mass of 2 % of the magnitude, two delays of 3 mrad together."""
    along = VALUE[0, 0] / abs(VALUE[0, 0])
    noise = 0.05**2 * np.outer([along.real, along.imag], [along.real, along.imag])

    def influence(name: str, effect: complex) -> Influence:
        return Influence(name, name.partition(" ")[0], 1e-3, "kg", np.array([[effect.real, effect.imag]]), "rig")

    turn = 1j * VALUE[0, 0]
    effects = {"mass": 0.02 * VALUE[0, 0], "delay 1": 1.8e-3 * turn, "delay 2": 2.4e-3 * turn}
    influences = tuple(influence(name, complex(effect)) for name, effect in effects.items())
    return Uncertainty((Contribution("noise", "A", noise[None]),), influences)


EVIDENCE = (
    InputEvidence("mass", "mass", 2.0, 1e-3, "kg", "M-17", "NMI", "", "rig.toml: load.mass", "2027-01-31"),
    InputEvidence("delay 1", "delay", 0.0, 1e-6, "s", "", "", "", "recording.toml: daq.a.channel.b.delay"),
    InputEvidence("delay 2", "delay", 0.0, 1e-6, "s", "", "", "", "recording.toml: daq.a.channel.b.delay"),
)


def test_shares_are_those_of_the_closed_form() -> None:
    found = {entry.name: entry for entry in trace_inputs(VALUE, _uncertainty(), EVIDENCE)}
    mass, delay = found["mass"], found["delay"]
    assert mass.of_magnitude == pytest.approx(0.8)
    assert mass.gain == pytest.approx(1.0 - math.sqrt((0.01**2 + 0.01**2) / (0.01**2 + 0.02**2)))
    assert mass.source == "M-17, NMI, valid until 2027-01-31"
    assert delay.of_phase == pytest.approx(1.0), "two unknowns of one key are one input"
    assert delay.of_magnitude == pytest.approx(0.0, abs=1e-12)
    assert sum(entry.of_magnitude for entry in found.values()) == pytest.approx(1.0)


def test_of_several_elements_the_largest_shares_count() -> None:
    one = trace_inputs(VALUE, _uncertainty(), EVIDENCE)
    other = trace_inputs(VALUE, _uncertainty(), ())
    merged = {(entry.name, entry.key): entry for entry in largest_of([one, other])}
    assert merged["mass", "rig.toml: load.mass"].of_magnitude == pytest.approx(0.8)
    page = traceability(one, "Fz/Fz")
    assert page["recalibration"].name == "mass"
    assert "M-17" in str(page["traceability"].rows)
    assert traceability(other, "Fz/Fz")["recalibration"] is None, "nothing says what could be calibrated anew"


@pytest.fixture(scope="module")
def exported(demo_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, str]]]:
    """Results of the demo recording, and its exported inputs."""
    out = tmp_path_factory.mktemp("traced")
    assert main(["run", str(demo_recording), "-o", str(out / "results"), "-q"]) == 0
    recording = out / "results" / "Fz-0080"
    assert main(["export", str(recording), "--inputs", "-o", str(out / "inputs.csv"), "-q"]) == 0
    return recording, rows(out / "inputs.csv")


Parts = tuple[complex, list[tuple[float, float, float, float]], list[tuple[float, float, float]]]


def _parts(found: list[dict[str, str]]) -> Parts:
    """Return value, noise (u_re, u_im, correlation, dof), and effects of unknowns with dof."""
    value = complex(float(found[0]["value_re"]), float(found[0]["value_im"]))
    noise, unknowns = [], []
    for row in found:
        u_re, u_im, correlation, dof = (float(row[key] or "inf") for key in ("u_re", "u_im", "correlation", "dof"))
        if row["u_input"] == "":
            noise.append((u_re, u_im, correlation, dof))
        else:
            unknowns.append((u_re, u_im, dof))
    return value, noise, unknowns


def _with_gtc(parts: Parts) -> tuple[float, float, float]:
    """Return u of the relative magnitude, u of the phase, and dof of the magnitude, by GTC."""
    value, noise, unknowns = parts
    total = complex(value)
    for u_re, u_im, correlation, dof in noise:
        mixed = correlation * u_re * u_im
        total = total + GTC.ucomplex(0.0, (u_re**2, mixed, mixed, u_im**2), max(dof, 2.0))
    for re, im, dof in unknowns:
        total = total + complex(re, im) * GTC.ureal(0.0, 1.0, dof)
    size, phase = GTC.magnitude(total), GTC.phase(total)
    return GTC.uncertainty(size) / abs(value), GTC.uncertainty(phase), GTC.dof(size)


def _with_uncertainties(parts: Parts) -> tuple[float, float, float]:
    """The same by the package uncertainties, which has no degrees of freedom."""
    package = pytest.importorskip("uncertainties", reason="the package uncertainties is not installed")
    umath = pytest.importorskip("uncertainties.umath")
    value, noise, unknowns = parts
    re, im = value.real, value.imag
    for u_re, u_im, correlation, _ in noise:
        mixed = correlation * u_re * u_im
        pair = package.correlated_values([0.0, 0.0], [[u_re**2, mixed], [mixed, u_im**2]])
        re, im = re + pair[0], im + pair[1]
    for effect_re, effect_im, _ in unknowns:
        unknown = package.ufloat(0.0, 1.0)
        re, im = re + effect_re * unknown, im + effect_im * unknown
    size, phase = umath.hypot(re, im), umath.atan2(im, re)
    return size.std_dev / abs(value), phase.std_dev, math.nan


@pytest.mark.parametrize("library", [_with_gtc, _with_uncertainties])
def test_other_libraries_recompute_the_uncertainty_from_the_exported_inputs(
    exported: tuple[Path, list[dict[str, str]]], library: Callable[[Parts], tuple[float, float, float]]
) -> None:
    results, inputs = exported
    values = [row for row in rows(results / "sensitivity.csv") if (row["channel"], row["component"]) == ("Fz", "Fz")]
    compared = 0
    for row in values:
        found = [one for one in inputs if one["kind"] == row["kind"] and one["frequency_hz"] == row["frequency_hz"]]
        if not found:
            continue
        compared += 1
        u_size, u_phase, dof = library(_parts(found))
        assert u_size == pytest.approx(float(row["u_magnitude"]) / float(row["magnitude"]), rel=0.01)
        assert u_phase == pytest.approx(float(row["u_phase_rad"]), rel=0.01)
        if math.isfinite(dof):
            assert t.ppf(0.975, dof) == pytest.approx(float(row["k_magnitude"]), rel=0.01)
    assert compared >= 2


def test_the_page_names_the_input_that_pays_most(exported: tuple[Path, list[dict[str, str]]]) -> None:
    page = (exported[0] / "report.html").read_text(encoding="utf-8")
    section = page[page.index('id="traceability"') :].partition("</section>")[0]
    assert "sensor.internal_mass" in section
    assert "A new calibration of internal mass: mass with half its uncertainty" in section


def test_folders_without_results_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sentence = refusals(capsys)("export", tmp_path, "--inputs", "-o", tmp_path / "inputs.csv")
    assert "result.h5" in sentence
    assert not (tmp_path / "inputs.csv").exists()
