"""Values along lines of points against the point-by-point evaluation, which goes by another formula for the weights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from photogram.bspline import evaluate, sample_line, spline_of_image

IMAGE = np.random.default_rng(51).uniform(0, 4095, (64, 70))
SPLINES = {degree: spline_of_image(IMAGE, degree) for degree in (3, 5, 7)}


def check(degree: int, start: tuple[float, float], step: tuple[float, float], count: int) -> None:
    points = np.asarray(start) + np.arange(count)[:, None] * np.asarray(step)
    grey = np.full(count, np.nan)
    sample_line(SPLINES[degree].coefficients, degree, *start, *step, grey)
    np.testing.assert_allclose(grey, evaluate(SPLINES[degree], points)[0], rtol=1e-12, atol=1e-12 * 4095)


@pytest.mark.parametrize("degree", [3, 5, 7])
@settings(max_examples=300, deadline=None)
@given(
    x=st.floats(0, 69),
    y=st.floats(0, 63),
    length=st.floats(0.5, 1.5),
    angle=st.one_of(st.floats(-0.1, 0.1), st.floats(-np.pi, np.pi)),
    count=st.integers(1, 44),
)
def test_lines_of_any_direction(degree: int, x: float, y: float, length: float, angle: float, count: int) -> None:
    step = (length * np.cos(angle), length * np.sin(angle))
    last_x, last_y = x + (count - 1) * step[0], y + (count - 1) * step[1]
    assume(0 <= last_x <= 69 and 0 <= last_y <= 63)
    check(degree, (x, y), step, count)


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize(
    ("start", "step", "count"),
    [
        ((0.0, 0.0), (1.0, 0.0), 70),
        ((0.0, 63.0), (1.0, 0.0), 70),
        ((69.0, 63.0), (-1.0, 0.0), 70),
        ((69.0, 0.0), (0.0, 1.0), 64),
        ((0.0, 62.9999999), (1.0, 1e-9), 70),
        ((38.0, 63.0), (1.0, 0.0), 32),
        ((5.3, 7.9999999), (1.0000001, 1e-8), 31),
        ((0.5, 20.0), (1.0 - 1e-14, -1e-14), 31),
    ],
)
def test_lines_along_pixels_and_edges(
    degree: int, start: tuple[float, float], step: tuple[float, float], count: int
) -> None:
    check(degree, start, step, count)


def test_nothing_but_the_line_is_written() -> None:
    grey = np.full(40, -1.0)
    sample_line(SPLINES[5].coefficients, 5, 20.3, 30.1, 0.999, 0.2, grey[4:17])
    assert np.all(grey[:4] == -1.0)
    assert np.all(grey[17:] == -1.0)
    assert np.all(grey[4:17] != -1.0)
