"""The figure of an operating deflection shape: what it calls noise is noise, and any body can be drawn."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from fusion.phasors.results import DeflectionShape
from fusion.report.motion_figures import draw_deflection

RIGID = np.array([1e-7, 2e-7j, 2e-5, 0, 0, 0], dtype=complex)


def shape_of(bend_m: float, seed: int = 0, axis: int = 2) -> DeflectionShape:
    """A plate normal to `axis`, bent, with noise."""
    rng = np.random.default_rng(seed)
    first, second = np.meshgrid(np.linspace(-0.05, 0.05, 24), np.linspace(-0.03, 0.03, 14))
    reference = np.zeros((first.size, 3))
    across = [i for i in range(3) if i != axis]
    reference[:, across[0]], reference[:, across[1]] = first.ravel(), second.ravel()
    value = np.zeros((2, first.size, 3), dtype=complex)
    value[1, :, axis] = bend_m * 1j * (first.ravel() / 0.05) ** 2
    u = np.full(value.shape, 3e-8)
    value += u * (rng.normal(size=value.shape) + 1j * rng.normal(size=value.shape))
    return DeflectionShape(np.array([50.0, 106.25]), reference, value, u)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bent_plate_is_drawn_from_any_side(axis: int) -> None:
    picture = draw_deflection(shape_of(1e-6, axis=axis), 1, RIGID, "top", "load")
    assert picture is not None
    assert ElementTree.fromstring(picture.svg).tag.endswith("svg")
    assert picture.name == "deflection-top"
    assert "106.2500 Hz" in picture.caption
    assert f"amplitude along {'xyz'[axis]}, out of the plane" in picture.caption
    assert "translation along z" in picture.caption
    assert picture.svg == draw_deflection(shape_of(1e-6, axis=axis), 1, RIGID, "top", "load").svg  # type: ignore[union-attr]


def test_noise_alone_is_above_its_level_at_one_point_in_twenty() -> None:
    counts = []
    for seed in range(6):
        picture = draw_deflection(shape_of(0.0, seed), 0, RIGID, "top", "load")
        assert picture is not None
        counts.append(int(picture.caption.split("; ")[1].split(" of ")[0]))
    assert np.mean(counts) / 336 == pytest.approx(0.05, abs=0.015)


def test_points_without_a_phasor_are_left_out() -> None:
    shape = shape_of(1e-6)
    value = shape.value.copy()
    value[:, :100] = np.nan
    picture = draw_deflection(replace(shape, value=value), 1, RIGID, "top", "load")
    assert picture is not None
    assert " of 236 points" in picture.caption
    value[:, 2:] = np.nan
    assert draw_deflection(replace(shape, value=value), 1, RIGID, "top", "load") is None
