"""Common errors of laser heads and accelerometer bodies, fans of beams, unobserved motion.

Readings are computed from rigid kinematics and finite rotations, independent of the rows under test.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from contracts import coverage_contract
from instrument_factory import channel_entry, with_values
from scipy.spatial.transform import Rotation
from simulated_phasors import lines_at
from support import channel

from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.estimation.fuse import fuse
from fusion.estimation.measurement_model import Deviates, Observation, UnobservedMotion
from fusion.instruments.channel import ChainUncertainty, ChannelReading, geometry_errors, observe_channels
from fusion.instruments.instrument_notices import PARALLEL_BEAMS, PARALLEL_BEAMS_WITHOUT_HEAD
from fusion.instruments.vibrometer import beam_notices
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.placement import LaserBeams
from fusion.recording.recording_notices import (
    CONTRADICTING_DIRECTION,
    KEY_NOT_APPLICABLE,
    UNKNOWN_NAME,
    VALUE_OUT_OF_RANGE,
)
from fusion.recording.rig import InstrumentHead, NamedHead
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensitivity.analyse import Inputs, analyse
from fusion.sensitivity.load_phasors import load_phasors
from fusion.sensitivity.monte_carlo import propagate
from fusion.sensitivity.moving_body import Body, make_moving_part
from fusion.sensor.identify.identification_inputs import placement_errors
from shaker.sine.phasor import Phasors

LINES = lines_at([106.25], [1])
OMEGA = 2.0 * np.pi * 106.25
DRIVE = 100.0
EIGHT = [(0.05 * np.cos(a), 0.05 * np.sin(a), 0.03) for a in 2.0 * np.pi * np.arange(8) / 8.0]
UP = np.array([0.0, 0.0, 1.0])
TILT_RAD = 5e-3
LASER: dict[str, Any] = {"common": "laser", "scale_uncertainty": 1e-5}
BODY = Body((make_moving_part("load", 7.0, [0.0, 0.0, 0.03], np.diag([0.01] * 3)),))


def head(name: str = "psv", **stated: Any) -> NamedHead:
    return NamedHead(name, InstrumentHead.model_validate(stated))


def motion(**components: complex) -> np.ndarray:
    """A rigid motion (6,) driven along z, m/s² and rad/s²."""
    names = ["x", "y", "z", "rx", "ry", "rz"]
    return np.array([components.get(n, DRIVE if n == "z" else 0.0) for n in names], dtype=complex)


def at(moved: np.ndarray, point: np.ndarray, direction: np.ndarray) -> complex:
    """What the material at a point does along a direction: d · (a + α × r)."""
    return complex(direction @ (moved[:3] + np.cross(moved[3:], point)))


def observed(entries: Sequence[Any], values: Sequence[complex], u: float = 1e-9) -> tuple[Observation, ...]:
    """Entries with what they read of an acceleration; noise over the drive."""
    readings = []
    for entry, value in zip(entries, values, strict=True):
        velocity = entry.quantity == "velocity"
        size = 1.0 / (1j * OMEGA) if velocity else 1.0
        covariance = (u * DRIVE * abs(size)) ** 2 * np.eye(2)[None]
        one, dof = np.array([[value * size]]), np.full(1, 1e6)
        found = Phasors(LINES.frequency_hz, one, covariance, (entry.name,), ("SI",), dof)
        readings.append(ChannelReading(entry, found, ChainUncertainty()))
    return observe_channels(readings)


def lasers(points: Any = EIGHT, **stated: Any) -> list[Any]:
    text = LASER | {"direction": tuple(UP)} | stated
    return [channel_entry(name=f"p{i}", point=tuple(point), **text) for i, point in enumerate(points)]


def expanded(covariance: np.ndarray, value: complex, component: int) -> float:
    """U of a magnitude from the covariance (12, 12), first order."""
    pair = np.ix_([component, component + 6], [component, component + 6])
    along = np.array([value.real, value.imag]) / abs(value)
    return float(coverage_factor(np.inf) * np.sqrt(along @ covariance[pair] @ along))


def anew(seen: Sequence[Observation], values: Sequence[complex]) -> tuple[Observation, ...]:
    """One instrument with other readings, given as accelerations along its channels."""
    (one,) = seen
    size = 1.0 if one.kind == "accelerometer" else 1.0 / (1j * OMEGA)
    return (with_values(one, np.array([values]) * size),)


def of_load(seen: Sequence[Observation], unseen: UnobservedMotion | None = None) -> tuple[list[float], list[float]]:
    """Magnitudes of z and Fz with their U."""
    fused = fuse(seen, unobserved_motion=unseen)
    load = load_phasors(fused, BODY)
    assert load.observed[0, 2]
    found = (fused.phasors.value, fused.phasors.covariance), (load.value, load.uncertainty.covariance)
    pairs = [(value[0, 2], spread[0]) for value, spread in found]
    return [abs(value) for value, _ in pairs], [expanded(spread, value, 2) for value, spread in pairs]


TRANSVERSE_MOTION = motion(x=0.1 * DRIVE)
TRUTH = [DRIVE, 7.0 * DRIVE]


def tilted(rng: np.random.Generator, common: float, own: float) -> list[complex]:
    """Eight beams of one head with common and individual tilts, on a body with 10 % transverse motion."""
    together = Rotation.from_rotvec(common * rng.normal(size=3))
    return [
        at(TRANSVERSE_MOTION, np.array(point), together.apply(Rotation.from_rotvec(own * rng.normal(size=3)).apply(UP)))
        for point in EIGHT
    ]


MANY = pytest.mark.parametrize("trials", [20, pytest.param(200, marks=pytest.mark.slow)])


@MANY
@pytest.mark.parametrize(("common", "own"), [(TILT_RAD, 0.0), (TILT_RAD, 2e-3)])
def test_a_common_tilt_is_covered_with_unobserved_transverse_motion(common, own, trials):
    """Direction errors counted as independent covered 11 % of these."""
    rng = np.random.default_rng(1)
    seen = observed(lasers(head=head(rotation_uncertainty=common), direction_uncertainty=own), [0.0] * 8)
    coverage_contract(lambda _: of_load(anew(seen, tilted(rng, common, own))), TRUTH, trials)


@MANY
@pytest.mark.parametrize(("common", "own"), [(TILT_RAD, 0.0), (0.0, TILT_RAD)])
def test_parallel_points_without_a_head_are_covered_for_common_and_individual_tilts(common, own, trials):
    rng = np.random.default_rng(2)
    seen = observed(lasers(direction_uncertainty=TILT_RAD), [0.0] * 8)
    coverage_contract(lambda _: of_load(anew(seen, tilted(rng, common, own))), TRUTH, trials, cautious=True)


def test_measured_transverse_motion_is_not_assumed_and_a_stated_limit_applies():
    entries = lasers(head=head(rotation_uncertainty=TILT_RAD))
    seen = observed(entries, [at(TRANSVERSE_MOTION, np.array(p), UP) for p in EIGHT])
    usual, quiet = (of_load(seen, unseen)[1][1] for unseen in (None, UnobservedMotion(0.01, 0.01)))
    assert usual == pytest.approx(1.96 * 0.1 * TILT_RAD * 7.0 * DRIVE, rel=0.02)
    assert quiet == pytest.approx(usual / 10.0, rel=0.05)
    (notice,) = (n for n in load_phasors(fuse(seen), BODY).notices if "x, y, rz" in n.text)
    assert notice.severity == "warning"
    across = (
        ((0.05, 0.0, 0.03), (1.0, 0.0, 0.0)),
        ((0.05, 0.0, 0.03), (0.0, 1.0, 0.0)),
        ((0.0, 0.05, 0.03), (1.0, 0.0, 0.0)),
    )
    three = [
        channel_entry(name=f"s{i}", common=f"s{i}", point=point, direction=direction, scale_uncertainty=1e-5)
        for i, (point, direction) in enumerate(across)
    ]
    seen = (*seen, *observed(three, [at(TRANSVERSE_MOTION, np.array(e.point), np.array(e.direction)) for e in three]))
    fused = fuse(seen)
    assert fused.observed.all()
    assert "unobserved motion" not in {part.label for part in fused.uncertainty.random}


def fan(moved: np.ndarray, mirror: np.ndarray, points: Any = EIGHT) -> list[complex]:
    """What beams read that leave one mirror, positive towards it."""
    lines = [mirror - np.array(point) for point in points]
    return [at(moved, np.array(p), line / np.linalg.norm(line)) for p, line in zip(points, lines, strict=True)]


MIRROR = np.array([0.0, 0.0, 0.53])


def test_a_fan_of_beams_is_half_a_percent_off_gone_with_its_mirror_and_covered_by_its_standoff():
    values = fan(motion(), MIRROR)
    found, _ = of_load(observed(lasers(), values))
    assert found[0] / DRIVE - 1.0 == pytest.approx(np.cos(np.arctan(0.1)) - 1.0, rel=1e-6)
    found, _ = of_load(observed(lasers(head=head(mirror=MIRROR.tolist()), direction=None), values))
    assert found[0] == pytest.approx(DRIVE, rel=1e-9)
    found, spread = of_load(observed(lasers(head=head(standoff=0.5)), values))
    assert 0.004 < 1.0 - found[0] / DRIVE < spread[0] / DRIVE < 0.007


@pytest.mark.parametrize("inertia", [0.01, 7.0 * 0.03 * (0.53 - 0.03)])
def test_transverse_motion_and_rocking_of_a_fan_have_one_cause(inertia):
    """Rocking by x/q about the mirror's foot: My of it is (J + m h²)·x/q, that of the motion itself m h·x.

    They are equal where the mirror is at the centre of percussion, q = h + J/(m h).
    """
    entries = lasers(head=head(mirror=MIRROR.tolist()), direction=None)
    body = Body((make_moving_part("load", 7.0, [0.0, 0.0, 0.03], np.diag([inertia] * 3)),))
    load = load_phasors(fuse(observed(entries, fan(motion(), MIRROR))), body)
    (transverse,) = (part for part in load.uncertainty.grouped() if part.label == "unobserved x")
    expected = abs((inertia + 7.0 * 0.03**2) / 0.53 - 7.0 * 0.03) * 0.1 * DRIVE / np.sqrt(2.0)
    assert np.sqrt(transverse.covariance[0, 4, 4]) == pytest.approx(expected, rel=1e-3, abs=1e-6)


@MANY
def test_a_misplaced_mirror_is_covered_with_rocking_and_transverse_motion(trials):
    """A fan measures three motions, those of the body at its mirror; the others are included in U."""
    rng = np.random.default_rng(3)
    stated = np.array([0.012, -0.007, 0.53])
    entries = lasers(head=head(mirror=stated.tolist(), mirror_uncertainty=2e-3), direction=None)
    blank = observed(entries, [0.0] * 8)

    def estimate(_: int) -> tuple[list[float], list[float]]:
        phase = np.exp(2j * np.pi * rng.random(3))
        moved = motion(x=0.1 * DRIVE * phase[0], rx=0.3 * DRIVE * phase[1], ry=1.0 * DRIVE * phase[2])
        return of_load(anew(blank, fan(moved, stated + 2e-3 * rng.normal(size=3))))

    coverage_contract(estimate, TRUTH, trials, cautious=True)
    seen = fuse(observed(entries, fan(motion(), stated)))
    np.testing.assert_array_equal(seen.observed[0], [False, False, True, True, True, False])
    # Rocking is known as well as the motion at the mirror: 10 % of the drive over half a metre, and no better.
    u_rocking = np.sqrt(seen.phasors.covariance[0, 4, 4] * 2.0)
    assert u_rocking == pytest.approx(0.1 * DRIVE / 0.53, rel=0.1)


@MANY
def test_an_accelerometer_body_is_tilted_as_one(trials):
    rng = np.random.default_rng(4)
    moved = motion(x=50.0)
    keys = {"quantity": "acceleration", "common": "triaxial", "scale_uncertainty": 1e-5, "point": (0.0, 0.0, 0.0)}

    def entries(**stated: Any) -> list[Any]:
        axes = [tuple(axis) for axis in np.eye(3).tolist()]
        return [channel_entry(name="a" + "xyz"[i], direction=axis, **keys, **stated) for i, axis in enumerate(axes)]

    body = entries(head=head("body", rotation_uncertainty=TILT_RAD))
    blank = observed(body, [0.0] * 3, 1e-6)

    def estimate(_: int) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_rotvec(TILT_RAD * rng.normal(size=3))
        fused = fuse(anew(blank, [at(moved, np.zeros(3), turn.apply(axis)) for axis in np.eye(3)]))
        u = np.sqrt(np.diagonal(fused.phasors.covariance[0])[:3])
        return fused.phasors.value[0, :3].real, 1.96 * u

    coverage_contract(estimate, moved[:3].real, trials)
    along = np.array([0.0] * 12)
    along[[0, 2]] = moved[[0, 2]].real / np.linalg.norm(moved)
    values = [at(moved, np.zeros(3), axis) for axis in np.eye(3)]

    def u_length(seen: list[Any]) -> float:
        return float(np.sqrt(along @ np.nan_to_num(fuse(observed(seen, values)).phasors.covariance[0]) @ along))

    # A body that is tilted as one keeps the length of what it reads; axes that err by themselves do not.
    assert u_length(body) < 0.05
    assert u_length(entries(direction_uncertainty=TILT_RAD)) > 0.2


@pytest.mark.parametrize(
    "stated",
    [
        {"rotation_uncertainty": [1e-3, 2e-3, 3e-3], "point_uncertainty": [1e-3, 2e-3, 5e-4]},
        {"mirror": [0.1, -0.05, 0.6], "mirror_uncertainty": [1e-3, 2e-3, 3e-3], "rotation_uncertainty": 1e-3},
        {"mirror": [0.1, -0.05, 0.6], "point_uncertainty": 1e-3},
        {"standoff": 5.0},
    ],
)
def test_drawn_heads_are_their_first_order_effects_for_small_errors(stated):
    laid = {"direction": None if "mirror" in stated else (0.0, 0.6, 0.8), "point_uncertainty": 5e-4}
    entries = lasers(EIGHT[:3], head=head(**stated), direction_uncertainty=1e-3, **laid)
    (seen,) = observed(entries, [0.0] * 3)
    drawn = seen.geometry.rows(seen.design, Deviates(1, 0, 20_000))[:, 0].imag.reshape(20_000, -1) * -OMEGA
    beams = LaserBeams.of(entries)
    effects: dict[str, np.ndarray] = {}
    for place, entry in enumerate(entries):
        for error in geometry_errors(TRANSDUCERS["velocity"], entry, beams):
            effects.setdefault(error.name, np.zeros((3, 6)))[place] += error.effect
    expected = sum(np.outer(effect, effect) for effect in effects.values())
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(drawn.T), expected, atol=0.05 * size.max(), rtol=0.1)
    assert seen.geometry.unknowns == set(effects) <= {error.name for error in seen.common}


def test_a_monte_carlo_run_covers_a_tilted_head_and_motion_at_its_limit():
    entries = lasers(head=head(rotation_uncertainty=TILT_RAD))
    seen = observed(entries, [at(motion(), np.array(p), UP) for p in EIGHT])
    inputs = Inputs(LINES, seen, body=BODY)
    (z, *_) = propagate(inputs, analyse(inputs), 4000, 1).results
    place = z.elements.index("z")
    # x and y at 10 % with any phase times a normal tilt: 0.1·5 mrad/√2 each in one part.
    assert z.magnitude.u[0, place] == pytest.approx(0.1 * TILT_RAD * DRIVE, rel=0.05)
    assert z.first_covariance[0, place, 0, 0] == pytest.approx(z.covariance[0, place, 0, 0], rel=0.1)


def test_an_identification_knows_that_base_and_load_share_a_head():
    base, top = lasers(EIGHT[:2], head=head(rotation_uncertainty=TILT_RAD), quantity="velocity")
    found = placement_errors(base, [top], "1")
    names = [error.name for error in found]
    assert sorted(set(names)) == ["head psv: tilt x [1]", "head psv: tilt y [1]"]
    assert len(names) == 4
    for error in found:
        axis = np.eye(3)["xy".index(error.name[15])]
        np.testing.assert_allclose(error.change[:3], TILT_RAD * np.cross(axis, UP), atol=1e-15)


def test_an_accelerometer_has_the_effect_of_a_turned_axis_in_gravity():
    entry = channel_entry(quantity="acceleration", head=head("body", rotation_uncertainty=[TILT_RAD, 0.0, 0.0]))
    (error,) = geometry_errors(TRANSDUCERS["acceleration"], entry)
    assert error.name == "head body: tilt x"
    turned = Rotation.from_rotvec([TILT_RAD, 0.0, 0.0]).apply(UP)
    np.testing.assert_allclose(error.effect[:3], turned - UP, atol=2e-5)


def test_points_of_one_direction_are_noted():
    (notice,) = beam_notices(lasers(direction_uncertainty=TILT_RAD))
    assert (notice.code, notice.where) == (PARALLEL_BEAMS_WITHOUT_HEAD.code, "laser")
    assert notice.values["beams"] == "8 along z"
    (of_head,) = beam_notices(lasers(head=head()))
    assert (of_head.code, of_head.where) == (PARALLEL_BEAMS.code, "head psv")
    assert beam_notices(lasers(head=head(mirror=MIRROR.tolist()), direction=None)) == ()
    assert beam_notices(lasers(head=head(standoff=0.5))) == ()
    assert beam_notices(lasers(EIGHT[:1], direction_uncertainty=TILT_RAD)) == ()


HEAD = "[head.top]\nmirror = [0.03, 0.0, 0.60]\nrotation_uncertainty = 1e-3\n\n[administration]"
POINT = "direction_uncertainty = 5e-3          # rad"
CRYSTAL = ("recording.toml", '"velocity"                 #', '"acceleration" #')
TRIGGERED = '\n  [[daq.channel]]\n  name = "camera_trigger"\n  quantity = "trigger"\n  threshold'
SIDEWAYS = "\n" + channel("across", "velocity", body="load", point=[0.0, 0, 0], direction=[1.0, 0, 0], head="top")
NAMED = ("recording.toml", POINT, f'{POINT}\n  head = "top"')


def test_a_channel_of_a_head_with_a_mirror_needs_no_direction_and_check_names_the_head(make_campaign):
    folder = make_campaign(replace=(("rig.toml", "[administration]", HEAD), NAMED))
    manifest = load_manifest(folder)
    assert manifest.daq[0].channel[0].head.stated.mirror == (0.03, 0.0, 0.6)
    assert manifest.shaker.unobserved_motion == UnobservedMotion(0.1, 0.1)
    assert any("head top: mirror at (0.03, 0, 0.6) m, 1 channels" in line for line in check(manifest).contents)
    aimed = ("recording.toml", "direction = [0.0, 0.0, 1.0]           # positive sense\n", "")
    shaken = ("recording.toml", "[excitation]", "[shaker]\ntransverse_motion = 0.03\n\n[excitation]")
    manifest = load_manifest(make_campaign(replace=(("rig.toml", "[administration]", HEAD), NAMED, aimed, shaken)))
    assert manifest.daq[0].channel[0].direction is None
    assert manifest.shaker.unobserved_motion == UnobservedMotion(0.03, 0.1)


@pytest.mark.parametrize(
    ("changes", "key", "declared", "values"),
    [
        ((NAMED,), "channel.velocity.head", UNKNOWN_NAME, ("top", "psv")),
        (
            (("rig.toml", "[administration]", HEAD.replace("0.03, 0.0", "0.13, 0.0")), NAMED),
            "channel.velocity.direction", CONTRADICTING_DIRECTION, ("177 mrad", "head top"),
        ),
        (
            (("rig.toml", "[administration]", HEAD), NAMED, CRYSTAL),
            "channel.velocity.head", UNKNOWN_NAME, ('quantity = "acceleration"',),
        ),
        (
            (("rig.toml", "[administration]", HEAD.replace("mirror =", "standoff = 0.5\nmirror =")), NAMED),
            "head.top.standoff", KEY_NOT_APPLICABLE, ("0.5",),
        ),
        (
            (
                ("rig.toml", "[administration]", "[head.top]\nstandoff = 0.5\n\n[administration]"),
                NAMED,
                ("recording.toml", TRIGGERED, SIDEWAYS + TRIGGERED),
            ),
            "channel.across.direction", CONTRADICTING_DIRECTION, ("channel velocity", "head top"),
        ),
        (
            (("rig.toml", "transverse_motion = 0.1", "transverse_motion = 0"),),
            "shaker.transverse_motion", VALUE_OUT_OF_RANGE, (),
        ),
    ],
)  # fmt: skip
def test_impossible_heads_are_refused(make_campaign, changes, key, declared, values):
    with pytest.raises(InputError) as caught:
        load_manifest(make_campaign(replace=changes))
    error = caught.value
    assert error.code == declared.code
    assert error.key.endswith(key)
    assert all(value in error.sentence for value in values), error.sentence
