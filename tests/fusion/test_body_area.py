"""The area in which subsets are laid, against the true outline of the body in rendered images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fusion.simulate.preset import PRESETS, face_of, nominal_rig
from fusion.simulate.world import Draws
from photogram.subsets.grid import textured_area
from photogram.synthetic.scene import render, view_of

BORDER_PX = 5  # beside the image's border nothing is tracked: the body would move out of the image


@pytest.mark.parametrize(("preset", "pair"), [("nitsche2018", 0), ("nitsche2018", 1), ("demo", 0), ("demo", 1)])
def test_the_body_is_covered_and_its_rim_left_out(preset: str, pair: int) -> None:
    """At least 98 % of what lies more than 2 px inside the rim, and nothing outside of that."""
    setup = PRESETS[preset].stereo[pair]
    rig, sensor_from_left = nominal_rig(setup)
    view = view_of(rig.left, sensor_from_left.inverse())
    face = face_of(setup, False, Draws(1, True).stream("speckle"))
    rest, once = np.zeros((1, 6)), np.ones(1)
    image = setup.sensor.digitise(render(view, face, rest, once), np.random.default_rng(2))
    plain = replace(face, dark=1.0, bright=1.0, background=0.0)
    body = render(replace(view, light=np.ones_like(view.light)), plain, rest, once, 1) > 0.5
    inside = ndimage.distance_transform_edt(np.pad(body, 9, mode="edge"))[9:-9, 9:-9] > 2.5
    area = textured_area(image)
    assert area[inside].mean() > 0.98
    middle = (slice(BORDER_PX, -BORDER_PX), slice(BORDER_PX, -BORDER_PX))
    assert not np.any(area[middle] & ~inside[middle])
