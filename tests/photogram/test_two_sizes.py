"""A pair whose cameras have images of different sizes and pixels: matched, tracked, and true."""

from __future__ import annotations

import numpy as np
from speckle import SENSOR, camera, face, sequence, two_poses

from photogram.camera import Camera, StereoRig
from photogram.measure.body import measure_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import render, view_of


def test_a_body_seen_by_cameras_of_two_sizes_moves_as_it_does():
    """200 x 180 px on the left; 164 x 170 px, 8 % smaller in the image and off the middle, on the right."""
    rng = np.random.default_rng(3)
    poses = np.vstack([np.zeros(6), rng.normal(size=(5, 6)) * [4e-5, 4e-5, 4e-5, 1e-3, 1e-3, 1e-3]])
    left, body, places = camera((100, 90)), face((0.016, 0.014), 5), two_poses()
    right = Camera.from_parameters(np.array([1380.0, 1380.0, 79.0, 91.5, 0, 0, 0, 0, 0]), np.array([164, 170]))
    images = tuple(
        sequence(
            [SENSOR.digitise(render(view_of(one, place), body, pose[None], np.ones(1)), rng) for pose in poses],
            SENSOR.full_scale,
        )
        for one, place in zip((left, right), places, strict=True)
    )
    assert [each.size_px for each in images] == [(200, 180), (164, 170)]
    rig = StereoRig(left, right, places[1] @ places[0].inverse())
    measured = measure_body(images, rig, places[0].inverse(), TrackSettings(radius_px=8))
    error = measured.motion.pose - measured.motion.pose[0] - (poses - poses[0])
    u = np.sqrt(np.einsum("fii->fi", measured.motion.covariance))[1:]
    assert np.isfinite(error).all()
    assert (np.abs(error[1:]) < 4.5 * np.sqrt(2.0) * u).all()  # the reference has noise of its own
    assert np.abs(error[1:, :3]).max() < 2e-6
