"""Motion of what carries cameras and lasers: against kinematics of `benchmarks/shaken_room.py`, and analytic cases."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from contracts import acceptance, refused
from shaken_room import CAMERAS, DRIVE, FACE, FREQUENCY_HZ, SCALES, Case, channel, estimated, pair, readings, trial

from fusion.errors import InputError
from fusion.estimation.fuse import fuse
from fusion.instruments.channel import observe_channels
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import InstrumentHead, NamedHead
from fusion.report.tables import supports_table
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.sensitivity.sensitivity_notices import (
    SUPPORT_CORRECTED,
    SUPPORT_EXCEEDS_LIMIT,
    SUPPORT_MOTION_NOT_ASSESSED,
    SUPPORT_UNCERTAIN,
)
from fusion.sensitivity.supports import without_supports
from fusion.simulate import simulate

QUIET = Case("at rest")
SHAKEN = Case("shaken", 5e-3)


def test_a_patch_at_rest_takes_off_what_shakes_and_costs_next_to_nothing_where_nothing_does():
    shaken, quiet = ([trial(case, seed) for seed in range(count)] for case, count in ((SHAKEN, 10), (QUIET, 25)))
    before, after = (np.array([f.before[0] for f in shaken]), np.array([f.error for f in shaken]))
    assert np.sqrt(np.mean(np.abs(before) ** 2)) > 1e-3
    assert np.sqrt(np.mean(np.abs(after) ** 2)) < 4e-4  # scale 2e-4 and noise of two pairs
    assert np.mean([f.u for f in quiet]) < 1.02 * np.mean([f.before[1] for f in quiet])
    scatter = [
        np.std([error.real for error in errors])
        for errors in zip(*((f.error, f.before[0]) for f in quiet), strict=True)
    ]
    assert scatter[0] < 1.05 * scatter[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [QUIET, SHAKEN, Case("lasers", 5e-3, instruments="lasers")], ids=lambda case: case.name
)
def test_intervals_hold_the_truth(case):
    held = np.array([trial(case, seed).held[:2] for seed in range(100)]).sum(axis=0)
    fewest, most = acceptance(100, 6)
    assert np.all((held >= fewest) & (held <= most))


def test_an_accelerometer_on_the_head_acts_by_its_own_errors():
    """The head moves by h along the beam: the beam reads a - h, and a is the sum of both; u has 0.3 % of h in it."""
    head, z = (
        NamedHead("psv", InstrumentHead()),
        {"body": "load", "point": (0.0, 0.0, 0.1), "direction": (0.0, 0.0, 1.0)},
    )
    laser = ChannelEntry(name="v", quantity="velocity", head=head, scale_uncertainty=1e-6, **z)
    sits = {"body": "head", "head": head, "scale_uncertainty": 3e-3}
    own = ChannelEntry(name="h", quantity="acceleration", **z | sits)
    a, h, turn = 10.0 + 1.0j, 0.5 - 0.2j, 2j * np.pi * FREQUENCY_HZ
    seen = observe_channels([channel(laser, (a - h) / turn, 1e-12), channel(own, h, 1e-9)])
    known, (moved,), notices = without_supports(seen, None)
    found = fuse(known)
    assert found.phasors.value[0, 2] == pytest.approx(a, rel=1e-6)
    budget = {part.label: part.covariance[0] for part in found.uncertainty.grouped()}
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(budget["h: scale"])[[2, 8]]), 3e-3 * np.abs([h.real, h.imag]), rtol=1e-3
    )
    assert moved.observed[0].tolist() == [False, False, True, False, False, False]
    assert moved.phasors.u_re[0, 2] == pytest.approx(3e-3 * h.real, rel=1e-3)
    (notice,) = notices
    assert (notice.code, notice.values["axis"]) == (SUPPORT_CORRECTED.code, "z")
    assert (notice.values["share"], notice.values["expanded"]) == ("5.624", "0.034")


def test_a_beam_at_the_room_reads_the_head_the_other_way():
    z = {"direction": (0.0, 0.0, 1.0), "head": NamedHead("psv", InstrumentHead()), "common": "laser"}
    laser = ChannelEntry(name="v", quantity="velocity", body="load", point=(0, 0, 0.1), scale_uncertainty=1e-6, **z)
    wall = ChannelEntry(name="w", quantity="velocity", body="room", point=(0, 0, 0.1), scale_uncertainty=1e-6, **z)
    a, h, turn = 10.0 + 1.0j, 0.5 - 0.2j, 2j * np.pi * FREQUENCY_HZ
    known, (moved,), _ = without_supports(
        observe_channels([channel(laser, (a - h) / turn, 1e-12), channel(wall, -h / turn, 1e-12)]), None
    )
    assert moved.name == "head psv"
    assert fuse(known).phasors.value[0, 2] == pytest.approx(a, rel=1e-6)
    assert moved.phasors.value[0, 2] == pytest.approx(h, rel=1e-4)


@pytest.mark.parametrize(("noise", "u"), [(5e-5, 2.6e-4), (1.0, 2.6e-3)])
def test_a_stated_bound_remains_where_a_patch_tells_nothing_and_is_used_up_where_it_tells(noise, u):
    """0.005 of the motion in any phase: 0.0025 in either part, as without a patch; with a good one only its noise."""
    known, _, notices = without_supports(readings(Case("", 0.0, noise=noise), np.random.default_rng(1)), 5e-3)
    found = fuse(known)
    assert found.phasors.u_re[0, 2] / abs(DRIVE) == pytest.approx(u, rel=0.15)
    assert "motion of the supports of lasers and cameras" not in {part.label for part in found.uncertainty.grouped()}
    assert any(notice.code == SUPPORT_UNCERTAIN.code for notice in notices) == (noise > 1e-3)


def test_a_bound_that_the_patch_refutes_is_told_and_not_used():
    rng = np.random.default_rng(2)
    seen = readings(Case("", 2e-2, along=True), rng)
    (moved,) = without_supports(seen, 1e-4)[1]
    notice = without_supports(seen, 1e-4)[2][0]
    assert (notice.code, notice.values["limit"]) == (SUPPORT_EXCEEDS_LIMIT.code, 1e-4)
    assert abs(moved.phasors.value[0, 2]) == pytest.approx(2e-2 * abs(DRIVE), rel=0.02)


def test_pairs_of_another_support_are_left_as_they_are():
    rng = np.random.default_rng(3)
    spread = estimated(rng, 1e-3, FACE, 0.02)
    room = pair("wall", "room", np.full(6, 0.1 + 0j), spread, FACE, SCALES["pair"])
    load = pair("top", "load", np.full(6, 1.0 + 0j), spread, CAMERAS, SCALES["pair"])
    alone = pair("side", "load", np.full(6, 1.0 + 0j), spread, CAMERAS, SCALES["pair"])
    other = alone.geometry.pair.model_copy(update={"support": None})
    alone = type(alone.geometry)("side", other, alone.phasors).observation()
    (corrected, same), _, _ = without_supports([room, load, alone], None)
    assert same is alone
    assert corrected is not load


WALL = """
[stereo.wall]
body = "room"
support = "top"
calibration = "calibration/top.json"
rotation = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
translation = [0.0, 0.0, 0.30]
scale_uncertainty = 2e-4
exposure = 40e-6
"""
IMAGES = """
[[images]]
stereo = "wall"
left = "top-left/*.tif"
right = "top-right/*.tif"
trigger = "camera_trigger"
region = [0, 0, 64, 64]
"""
ON_HEAD = """
  [[daq.channel]]
  name = "h"
  quantity = "acceleration"
  body = "head"
  head = "psv"
  point = [0.0, 0.0, 0.6]
  direction = [0.0, 0.0, 1.0]
"""


@pytest.fixture
def make_room(make_campaign: Callable[..., Path], format_examples: dict[str, str]) -> Callable[..., Path]:
    def make(
        wall: str = WALL,
        on_head: str = ON_HEAD,
        laser: str = 'quantity = "velocity"\n  head = "psv"',
        region: str = "region = [80, 0, 64, 64]",
    ) -> Path:
        recording = format_examples["recording"].replace('quantity = "velocity"', laser, 1)
        recording = recording.replace("  direction = [0.0, 0.0, 1.0]           # positive sense\n", "", 1)
        first = recording.index('\n[[daq]]\nname = "bridge"')
        recording = recording[:first] + on_head + recording[first:]
        recording = recording.replace("first_edge = 0 ", f"{region}\nfirst_edge = 0 ", 1)
        at = recording.index("\n[[points]]")
        return make_campaign(format_examples["rig"] + wall + BASE, recording[:at] + IMAGES + recording[at:])

    return make


BASE = """
[stereo.base]
body = "base"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [0.0, 0.0, 0.0]
scale_uncertainty = 2e-4
exposure = 40e-6
"""


def test_a_manifest_states_what_is_at_rest(make_room):
    manifest = load_manifest(make_room())
    assert manifest.rig.stereo["wall"].body == "room"
    observed = {(o.body, o.instrument): o.components for o in check(manifest).observed}
    assert observed["cameras top", "stereo wall"] == ("x", "y", "z", "rx", "ry", "rz")
    assert observed["head psv", "vibrometer.h"] == ("z",)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wall": WALL.replace('support = "top"\n', "")}, r"stereo.wall.support: "),
        ({"wall": WALL.replace('"top"\n', '"frame"\n', 1)}, r'"frame".* base, top'),
        ({"laser": 'quantity = "velocity"\n  direction = [0.0, 0.0, 1.0]'}, r'channel.h.head: .*"psv"'),
        ({"region": ""}, r"images.top.region: "),
        ({"on_head": ON_HEAD.replace('  head = "psv"\n', "")}, r'channel.h.head: .*"head"'),
        ({"on_head": ON_HEAD.replace("acceleration", "velocity")}, r"channel.h.body: "),
        ({"on_head": ON_HEAD.replace('"head"', '"room"')}, r"channel.h.body: "),
    ],
)
def test_references_without_a_support_are_refused(make_room, change, words):
    refused(words, load_manifest, make_room(**change), error=InputError)


@pytest.mark.slow
def test_a_rendered_recording_on_a_floor_that_shakes(tmp_path):
    """The same noise with and without 0.5 % of shake: what is left of it is a fiftieth."""
    found = {}
    for violate in ((), ("floor-shake",)):
        folder = tmp_path / ("-".join(violate) or "still")
        recording = simulate(folder, "room", 1, frames=24, violate=violate, systematic_errors=False)
        found[violate] = evaluate_recording(load_manifest(recording))
    still, shaken = (found[v].element.value[0, 2, 2] for v in ((), ("floor-shake",)))
    assert abs(shaken / still - 1.0) < 1e-4
    u = [found[v].accelerations[0].phasors.u_re[0, 2] for v in ((), ("floor-shake",))]
    assert u[1] < 1.05 * u[0]
    assert {moved.name for moved in found["floor-shake",].supports} == {"cameras frame", "head psv"}
    codes = [notice.code for notice in found["floor-shake",].notices]
    assert codes.count(SUPPORT_CORRECTED.code) == 2
    assert SUPPORT_MOTION_NOT_ASSESSED.code not in codes
    page = supports_table(found["floor-shake",])
    assert [row[3] for row in page.rows if row[0] == "cameras frame"][:6] == ["x", "y", "z", "rx", "ry", "rz"]
    shares = {row[3]: row[5] for row in reversed(page.rows)}
    assert float(str(shares["z"]).split()[0]) == pytest.approx(0.5, abs=0.04)
    labels = {part.label for part in found["floor-shake",].element.uncertainty.grouped()}
    assert {"motion of cameras frame", "motion of head psv", "head_acceleration: scale"} <= labels
