"""Shapes of a body that bends, fitted to grey values beside its motion: against faces that were rendered bent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from speckle import SENSOR, camera, face, spline_frames, two_poses

from photogram.bspline import spline_of_image
from photogram.direct.direct_fit import BodyView, DirectFit, fit_direct, rigid_share, view_body
from photogram.direct.fit_torch import fit_frames, torch_view
from photogram.direct.surface import PlacedCamera, PlainShapes
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.subsets.texture import textured_area
from photogram.synthetic.scene import bend_view, motion_bound, render, view_of

FACE = face((0.017, 0.017), 7, is_round=True)
PLACES = tuple(PlacedCamera(camera((110, 100), (-0.1, 0.1, 2e-4, -1e-4, 0.0)), place) for place in two_poses(0.1))
VIEWS = [view_of(place.camera, place.camera_from_body) for place in PLACES]
MODEL = NoiseModel(SENSOR.read_noise_grey**2 + 1 / 12, 1 / SENSOR.electrons_per_grey)
REACH_M, SIZE_M, STILL = 0.017, 1e-6, np.zeros(6)
RIM = REACH_M * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
KNOWN = np.concatenate([share * RIM for share in (0.0, 0.25, 0.5, 0.75, 1.0)])
Bending = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _across(of: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Bending:
    return lambda u, v: np.stack([0 * u, 0 * u, of(u / REACH_M, v / REACH_M)], axis=-1)


def _along(of: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Bending:
    return lambda u, v: np.stack([*of(u / REACH_M, v / REACH_M), 0 * u], axis=-1)


# Written anew: what each name promises, on a face in the plane z = 0.
BENT: dict[str, Bending] = {
    "bowl": _across(lambda u, v: u**2 + v**2),
    "saddle": _across(lambda u, v: u**2 - v**2),
    "twist": _across(lambda u, v: 2 * u * v),
    "breathing": _along(lambda u, v: (u, v)),
    "stretch": _along(lambda u, v: (u, -v)),
    "shear": _along(lambda u, v: (v, u)),
}


def pictures(bending: Bending | None, size_m: float = SIZE_M, pose: np.ndarray = STILL) -> list[np.ndarray]:
    seen = VIEWS
    if bending is not None:
        seen = [bend_view(view, FACE, pose, lambda u, v: size_m * bending(u, v)) for view in VIEWS]
    return [render(view, FACE, pose[None], np.ones(1)) * SENSOR.full_scale for view in seen]


REST = pictures(None)


def body(rng: np.random.Generator | None = None, shapes: PlainShapes | None = None) -> list[BodyView]:
    rest = REST if rng is None else [SENSOR.digitise(image / SENSOR.full_scale, rng) for image in REST]
    found = []
    for place, image, clean in zip(PLACES, rest, REST, strict=True):
        inside = np.zeros(image.shape, dtype=bool)
        inside[5:-5, 5:-5] = True
        seen = spline_of_image(image), textured_area(clean) & inside, SENSOR.full_scale
        found.append(view_body(place, seen, KNOWN, 21, MODEL, PlainShapes.of(KNOWN) if shapes is None else shapes))
    return found


def fitted(views: list[BodyView], images: list[np.ndarray], pose: np.ndarray = STILL) -> DirectFit:
    fit = fit_direct(views, [spline_of_image(image) for image in images], RigidTransform.from_pose(pose))
    assert fit is not None
    return fit


def test_every_plain_shape_is_found_by_its_name_and_amplitude():
    views, shapes = body(), PlainShapes.of(KNOWN)
    assert shapes.names == tuple(BENT)
    assert shapes.reach_m == pytest.approx(REACH_M, rel=1e-12)
    at_rest, share = fitted(views, REST), rigid_share(views)
    for number, bending in enumerate(BENT.values()):
        fit = fitted(views, pictures(bending))
        amplitude = fit.amplitude - at_rest.amplitude
        assert amplitude[number] == pytest.approx(SIZE_M, rel=3e-3)
        assert np.abs(np.delete(amplitude, number)).max() < 5e-3 * SIZE_M
        # What a rigid body would make of it, which is taken off where the amplitude counts.
        error = fit.moved.pose - at_rest.moved.pose - share @ amplitude
        assert np.abs(error[:3]).max() < 0.02 * SIZE_M
        assert np.abs(error[3:]).max() < 0.06 * SIZE_M / REACH_M


def test_shapes_take_no_part_in_the_motion():
    rng = np.random.default_rng(3)
    pose = np.array([2e-5, -1e-5, 3e-5, 2e-4, -1e-4, 1e-4])
    views = body(np.random.default_rng(1))
    images = [SENSOR.digitise(image / SENSOR.full_scale, rng).astype(float) for image in pictures(None, 0.0, pose)]
    plain = [
        BodyView(
            v.camera,
            v.cells,
            v.patches,
            v.rates[..., :6],
            v.information[:, :6, :6],
            v.information_noise[:, :6, :6],
            v.inverse_shift_hessian,
        )
        for v in views
    ]
    both = [fitted(seen, images) for seen in (views, plain)]
    u = np.sqrt(np.diagonal(both[0].covariance))
    assert np.abs(both[0].moved.pose - both[1].moved.pose).max() < 1e-9 * u.min()
    assert both[0].covariance == pytest.approx(both[1].covariance, rel=1e-9)
    assert both[1].amplitude.shape == (0,)


def test_an_engine_for_devices_finds_the_same_amplitudes():
    rng = np.random.default_rng(4)
    views = body(np.random.default_rng(1))
    series = [
        [SENSOR.digitise(image / SENSOR.full_scale, rng).astype(float) for image in pictures(BENT[name], 3 * SIZE_M)]
        for name in ("bowl", "shear")
    ]
    targets = [(spline_frames(np.stack(side), 5, "cpu", "float64"), [0, 1]) for side in zip(*series, strict=True)]
    together = fit_frames([torch_view(view, "cpu", "float64") for view in views], targets, np.zeros((2, 6)))
    for images, other in zip(series, together, strict=True):
        own = fit_direct(views, [spline_of_image(image, 5) for image in images], RigidTransform.identity())
        assert own is not None
        assert other is not None
        u = np.sqrt(np.diagonal(own.amplitude_covariance))
        assert np.abs(own.amplitude - other.amplitude).max() < 0.01 * u.min()
        assert other.amplitude_covariance == pytest.approx(own.amplitude_covariance, rel=1e-3)


@pytest.mark.slow
def test_amplitudes_scatter_as_stated_and_by_little_more_than_the_bound():
    rng, trials = np.random.default_rng(11), 150
    views = body(rng)
    images = pictures(BENT["saddle"])
    found, stated = [], []
    for _ in range(trials):
        fit = fitted(views, [SENSOR.digitise(image / SENSOR.full_scale, rng).astype(float) for image in images])
        found.append(fit.amplitude)
        stated.append(np.diagonal(fit.amplitude_covariance))
    scatter = np.std(found, axis=0, ddof=1)
    bound = np.sqrt(np.diagonal(motion_bound(VIEWS, FACE, SENSOR, shapes=list(BENT.values())))[6:])
    spread = 1 / np.sqrt(2 * (trials - 1))
    assert np.all(np.abs(scatter / np.sqrt(np.mean(stated, axis=0)) - 1) < 4 * spread)
    assert np.all(scatter / bound > 1 - 3 * spread)
    assert np.all(scatter / bound < 1.45 + 3 * spread)  # the rim, where shapes are largest, is left out of the cells
    mean = np.mean(found, axis=0) - fitted(views, REST).amplitude
    assert abs(mean[1] / SIZE_M - 1) < 0.05 + 4 * scatter[1] / np.sqrt(trials) / SIZE_M
