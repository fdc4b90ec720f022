"""What the images of a simulated recording allow at best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.draws import Draws
from fusion.simulate.preset import PRESETS
from fusion.simulate.scenery import face_of
from fusion.simulate.world import make_world
from photogram.synthetic import motion_bound, view_of


def frame_bounds(preset: str, seed: int) -> dict[str, NDArray[np.float64]]:
    """Return per stereo pair the Cramér-Rao bound of one frame's motion: standard deviations (6,) in m and rad.

    All pixels of both cameras with the true rig and the nominal noise (`photogram.synthetic.motion_bound`).
    """
    draws = Draws(seed, True)
    bounds = {}
    for stereo in make_world(PRESETS[preset], draws, 0.0).stereo:
        face = face_of(stereo.setup, False, draws.stream(f"{stereo.setup.name}.speckle"))
        right_from_sensor = stereo.rig.right_from_left @ stereo.left_from_sensor
        views = [view_of(stereo.rig.left, stereo.left_from_sensor), view_of(stereo.rig.right, right_from_sensor)]
        bounds[stereo.setup.name] = np.sqrt(np.diagonal(motion_bound(views, face, stereo.setup.sensor)))
    return bounds
