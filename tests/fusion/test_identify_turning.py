"""`shakercal identify` of a base that is turned: chirps of two moments of inertia against the closed form."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.cli import main
from fusion.sensor.identify.evaluate import evaluate_campaign
from fusion.sensor.identify.fit import joint_fits
from fusion.sensor.identify.measured import IdentifySettings, read_campaign
from fusion.sensor.identify.run import read_model
from fusion.simulate import chirp as pitching
from fusion.simulate.channels import to_toml
from fusion.simulate.chirp import (
    Chirp,
    chirp_channels,
    chirp_samples,
    chirp_tables,
    rig_file,
    rig_tables,
    write_chirp_files,
)
from fusion.simulate.preset import PartSpec
from fusion.simulate.world import Draws

K_RY, B_RY, J_I, U_INTERNAL = 1.07e6, 4.0, 1.5e-3, 1e-4  # N·m/rad, N·m·s/rad, kg·m²
LOADS = {"small": (5.0, 0.0, 0.0182), "large": (5.0, 0.0, 0.0412)}  # kg, height of the centre of mass in m, kg·m²
HIGH = {"small": (4.236, 0.012, 0.0182), "large": (6.962, -0.012, 0.0118)}
K_X, B_X, M_I = 7.0e8, 2500.0, 0.9
U_J, U_PLACE, BASE_M, TOP_M = 2e-5, 5e-4, 0.15, 0.09
Load = tuple[float, float, float]
CHIRP = Chirp(sample_rate_hz=12800.0, period_s=0.64, periods=4, band_hz=(500.0, 1700.0))
ABOUT_Y = [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def _turned(load: Load, off: float) -> Callable[[NDArray[np.float64]], NDArray[np.complex128]]:
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


def _write(folder: Path, *, rate: bool, loads: dict[str, Load] = LOADS, chirp: Chirp = CHIRP, seed: int = 3) -> Path:
    """A rig and a chirp for each load; drawn: chains, moments of inertia, the place of the load's accelerometer.

    With `rate` the channels are stated to be gyroscopes, whose rate a transfer function turns into an acceleration.
    """
    draws, rng = Draws(seed, True), np.random.default_rng(seed)
    off = 0.0 if rate else U_PLACE * float(rng.standard_normal())
    internal = PartSpec("internal", 0.9, 0.002, (0.0, 0.0, 0.0), 0.0, (J_I, J_I, J_I), U_INTERNAL)
    folder.mkdir()
    for name, (mass, height, inertia) in loads.items():
        part = PartSpec(f"load {name}", mass, 3e-4, (0.0, 0.0, height), 0.0, (inertia,) * 3, U_J)
        (folder / rig_file(name)).write_text(
            to_toml(rig_tables(replace(pitching.PITCHING_STAND, internal=internal), part, draws))
        )
        true = (mass, height, inertia + U_J * float(rng.standard_normal()))
        samples = chirp_samples(chirp, draws, {"top": _turned(true, off)}, f"{name}.")
        channels = chirp_channels(chirp, (0.0, 0.0, BASE_M), {"top": (0.0, 0.0, TOP_M)}, (1.0, 0.0, 0.0))
        entries = [_gyroscope(channel) if rate else _placed(channel) for channel in channels]
        tables = chirp_tables(chirp, f"turned, {name}", f"../{rig_file(name)}", entries)
        tables["excitation"]["direction"] = ABOUT_Y
        write_chirp_files(folder / f"chirp-{name}", chirp, samples, tables, {})
    return folder


def _placed(channel: dict[str, Any]) -> dict[str, Any]:
    """An accelerometer; the place of that on the load is uncertain."""
    return channel | ({"point_uncertainty": U_PLACE} if channel["name"] == "top" else {})


def _gyroscope(channel: dict[str, Any]) -> dict[str, Any]:
    """A gyroscope about y in place of an accelerometer, whose lever is in its scale."""
    lever = BASE_M if channel["name"] == "base" else TOP_M
    stated = channel | {"quantity": "angular_velocity", "direction": [0.0, 1.0, 0.0], "scale": 100.0 / lever}
    del stated["point"]
    return stated


@pytest.mark.parametrize("rate", [False, True])
def test_a_turned_base_gives_torsional_stiffness_and_damping(tmp_path: Path, rate: bool) -> None:
    folder = _write(tmp_path / "campaign", rate=rate)
    (component,) = evaluate_campaign(read_campaign(folder), IdentifySettings()).components
    found = component.fit.identification
    assert (component.name, component.fit.model, component.fit.mass_is_free) == ("ry", "translation", True)
    assert found.names == ("stiffness_ry", "damping_ry", "internal_inertia_ry")
    assert [estimate.unit for estimate in found.estimates] == ["N·m/rad", "N·m·s/rad", "kg·m²"]
    for name, true in zip(found.names, (K_RY, B_RY, J_I), strict=True):
        assert abs(found.value(name) - true) < 3.5 * found.u(name)
    assert found.u("stiffness_ry") < 2e-3 * K_RY
    assert found.u("damping_ry") < 0.02 * B_RY
    names = [unknown.name for unknown in found.unknowns]
    placed = [name for name in names if "point top" in name]
    assert placed == ([] if rate else ["top: point top at (0, 0, 0.09) z [1]"])
    (alone,) = joint_fits(component.fit.prepared[:1], IdentifySettings())
    assert not alone.mass_is_free
    assert alone.identification["internal_inertia_ry"].value == pytest.approx(J_I, abs=1e-6)
    assert alone.identification.u("internal_inertia_ry") == pytest.approx(U_INTERNAL, rel=1e-2)
    assert abs(alone.identification.value("stiffness_ry") - K_RY) < 3.5 * alone.identification.u("stiffness_ry")


def test_files_and_page_have_the_units_of_a_rotation(tmp_path: Path) -> None:
    folder = _write(tmp_path / "campaign", rate=False)
    assert main(["identify", str(folder), "-o", str(tmp_path / "out"), "-q"]) == 0
    with (tmp_path / "out" / "parameters.csv").open(encoding="utf-8", newline="") as stream:
        units = {row["name"]: row["unit"] for row in csv.DictReader(stream)}
    assert (units["stiffness_ry"], units["damping_ry"]) == ("N.m/rad", "N.m.s/rad")
    assert (units["internal_inertia_ry"], units["lag_ry"]) == ("kg.m^2", "s")
    sensor = read_model(tmp_path / "out")["My"].sensor
    assert sensor.stiffness == pytest.approx(K_RY, rel=5e-3)
    assert sensor.unit == "(V/V)/(N.m)"
    page = (tmp_path / "out" / "identify.html").read_text(encoding="utf-8")
    assert "load / kg·m²" in page


def test_a_load_that_also_shifts_is_two_modes(tmp_path: Path) -> None:
    chirp = replace(CHIRP, period_s=0.32, band_hz=(600.0, 2400.0))
    folder = _write(tmp_path / "campaign", rate=False, loads=HIGH, chirp=chirp)
    (component,) = evaluate_campaign(read_campaign(folder), IdentifySettings()).components
    found = component.fit.identification
    assert (component.name, component.fit.model, component.bands) == ("ry", "pitching", ())
    truth = {"stiffness_ry": K_RY, "stiffness_x": K_X, "damping_ry": B_RY, "damping_x": B_X, "internal_mass": M_I}
    for name, true in {**truth, "internal_inertia_ry": J_I}.items():
        assert abs(found.value(name) - true) < 3.5 * found.u(name)
    assert found.u("stiffness_ry") < 0.01 * K_RY
