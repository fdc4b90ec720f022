"""The rig in space: where everything is drawn, how it moves, that names are no markup; and the page in a browser."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from browsing import Page
from contracts import slow
from page_outline import self_contained
from scipy.spatial.transform import Rotation
from take_factory import POINTS, Shot, write_takes

from fusion.cli import main
from fusion.phasors.deformation import DeflectionShape
from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.rig import InstrumentHead, NamedHead
from fusion.report.folder import render_page
from fusion.report.motion_figures import MOST_POINTS
from fusion.report.moving_image import moving_images
from fusion.report.recording_report import render_report
from fusion.report.report_scene import (
    Scene,
    SceneMotion,
    displacement,
    evaluation_scene,
    frustum,
    rig_page,
    rig_scene,
    scene_page,
)
from fusion.report.scene_views import SceneShape, solid, static_views
from photogram.camera import Camera
from photogram.geometry import RigidTransform

NASTY = "</script><img src=x onerror=alert(1)>\u2028\"'&"


@pytest.fixture(scope="module")
def manifest(demo_recording: Path) -> Manifest:
    return load_manifest(find_recordings(demo_recording)[0])


def shape_of(scene: Scene, name: str) -> SceneShape:
    (found,) = (shape for shape in scene.shapes if shape.name == name)
    return found


def with_channel(manifest: Manifest, which: str, **changes: Any) -> Manifest:
    """The recording with another entry of one channel."""
    daqs = []
    for daq in manifest.daq:
        entries = [e.model_copy(update=changes) if e.name == which else e for e in daq.channel]
        daqs.append(daq.model_copy(update={"channel": tuple(entries)}))
    return replace(manifest, daq=tuple(daqs))


# Geometry.


def test_a_frustum_agrees_with_opencv_at_the_corners_of_the_image():
    camera = Camera.from_parameters(
        np.array([1600.0, 1580.0, 150.0, 125.0, -0.15, 0.08, 1e-3, -2e-3, 0.01]), np.array([304, 240])
    )
    pose = RigidTransform(Rotation.from_euler("xyz", [2.8, 0.2, -0.3]).as_matrix(), np.array([0.1, -0.2, 0.5]))
    corners = np.array([[-0.5, -0.5], [303.5, -0.5], [303.5, 239.5], [-0.5, 239.5]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    rays = cv2.undistortPoints(corners[:, None], camera.matrix, camera.distortion, None, None, None, criteria)[:, 0]
    expected = [pose.rotation @ (0.4 * np.array([x, y, 1.0])) + pose.translation_m for x, y in rays]
    np.testing.assert_allclose(frustum(camera, pose, 0.4), expected, atol=1e-9)


def test_cameras_look_at_the_faces_that_the_simulation_placed(manifest):
    """Face centres of the preset; nothing but rig.toml and calibrations is read."""
    scene = rig_scene(manifest)
    for name, face, tilt in (("top", (0.0, 0.0, 0.069), 0.04), ("base", (0.0, -0.070, -0.052), 0.03)):
        for side in ("left", "right"):
            camera = shape_of(scene, f"camera {name} {side}")
            np.testing.assert_allclose(camera.points_m[1:5].mean(axis=0), face, atol=tilt * 0.05)
            assert camera.body == ""
        # The preset's cameras stand on both sides of the plane x = 0.
        left, right = (shape_of(scene, f"camera {name} {side}").points_m[0] for side in ("left", "right"))
        np.testing.assert_allclose(right, left * [-1.0, 1.0, 1.0], atol=1e-6)
    assert sum(remark.startswith("Stereo ") for remark in scene.remarks) == 1  # one kind of target for both pairs


def test_a_pair_without_calibration_is_described_but_not_drawn(make_campaign):
    scene = rig_scene(load_manifest(make_campaign()))
    assert "camera base left" not in [shape.name for shape in scene.shapes]
    np.testing.assert_allclose(shape_of(scene, "frame of base").points_m, [[0.0, 0.0, -0.1]])
    assert [remark.partition(":")[0] for remark in scene.remarks[-2:]] == ["Stereo top", "Stereo base"]


@pytest.mark.parametrize("shape", ["cylinder", "block"])
def test_a_solid_has_the_inertia_that_it_is_drawn_for(shape):
    """Inertia by summing small cubes that fill a turned body, against the sizes it was filled with."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 61)] * 3), axis=-1).reshape(-1, 3)
    if shape == "cylinder":
        sizes = np.array([0.08, 0.08, 0.05])
        grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= 0.5]
    else:
        sizes = np.array([0.08, 0.05, 0.03])
    turn, centre = Rotation.from_euler("xyz", [0.3, -0.5, 0.9]).as_matrix(), np.array([0.01, -0.02, 0.04])
    filled, mass = (grid * sizes) @ turn.T, 1.7
    inertia = mass * np.mean(
        [np.sum(filled**2, axis=1)[:, None, None] * np.eye(3) - filled[:, :, None] * filled[:, None, :]], axis=(0, 1)
    )
    points, faces, edges, name = solid(mass, centre, inertia)
    assert shape in name
    own = np.abs((points - centre) @ turn)
    np.testing.assert_allclose(own.max(axis=0) * 2.0, sizes, rtol=0.05)
    for face in faces:  # counter-clockwise from outside
        a, b, c = points[list(face[:3])]
        assert np.cross(b - a, c - b) @ (points[list(face)].mean(axis=0) - centre) > 0.0
    assert {k for edge in edges for k in edge} == set(range(len(points)))


def test_beams_end_on_their_points_and_come_from_the_mirror_or_the_free_side(manifest):
    plain = rig_scene(manifest)
    point = np.array([0.033, 0.0, 0.069])
    beam, sense = shape_of(plain, "beam of velocity_1"), shape_of(plain, "velocity_1")
    np.testing.assert_allclose(beam.points_m[1], point)
    assert beam.points_m[0][2] > point[2]
    assert beam.dashed
    np.testing.assert_allclose(np.diff(sense.points_m, axis=0)[0][:2], 0.0, atol=1e-12)
    assert sense.points_m[1][2] > point[2]
    other = rig_scene(with_channel(manifest, "velocity_1", direction=(0.0, 0.0, -1.0)))
    assert shape_of(other, "velocity_1").points_m[1][2] < point[2]  # the sense turns, the beam stays outside
    np.testing.assert_allclose(shape_of(other, "beam of velocity_1").points_m, beam.points_m)
    head = NamedHead("scanner", InstrumentHead(mirror=(0.1, 0.2, 0.9)))
    aimed = rig_scene(with_channel(manifest, "velocity_1", direction=None, head=head))
    beam, sense = shape_of(aimed, "beam of velocity_1"), shape_of(aimed, "velocity_1")
    np.testing.assert_allclose(beam.points_m, [(0.1, 0.2, 0.9), point])
    step = np.diff(sense.points_m, axis=0)[0]
    np.testing.assert_allclose(np.cross(step, np.array([0.1, 0.2, 0.9]) - point), 0.0, atol=1e-12)
    assert not beam.dashed
    assert "head scanner" in [shape.name for shape in aimed.shapes]


def test_every_take_has_separate_points(tmp_path):
    folder = write_takes(tmp_path, [Shot([point]) for point in POINTS], np.random.default_rng(1))
    scene = rig_scene(load_manifest(folder / "recording.toml"))
    seen = [shape for shape in scene.shapes if shape.name == "velocity_1"]
    np.testing.assert_allclose([shape.points_m[0] for shape in seen], POINTS)
    assert [shape.label for shape in seen] == ["velocity_1", *[""] * 7]


def test_gravity_points_down_and_up_is_against_it(manifest):
    around = manifest.rig.surroundings.model_copy(update={"gravity": (0.0, 9.81, 0.0)})
    scene = rig_scene(replace(manifest, rig=manifest.rig.model_copy(update={"environment": around})))
    np.testing.assert_allclose(scene.up, [0.0, -1.0, 0.0])
    down = np.diff(shape_of(scene, "gravity").points_m, axis=0)[0]
    np.testing.assert_allclose(down / np.linalg.norm(down), [0.0, 1.0, 0.0], atol=1e-12)
    unknown = rig_scene(replace(manifest, rig=manifest.rig.model_copy(update={"environment": None})))
    assert "Gravity is not stated; the sensor's z axis points up." in unknown.remarks


# Motion.


def test_displacement_twice_differentiated_is_the_acceleration(demo_evaluation):
    fused = next(a for a in demo_evaluation.accelerations if (a.body, a.source) == ("load", "fused"))
    found = displacement(fused)
    for k, frequency in enumerate(fused.phasors.frequency_hz):
        h = 1e-4 / frequency
        time = np.array([-h, 0.0, h])[:, None] + 0.3 / frequency
        x = np.real(found[k] * np.exp(2j * np.pi * frequency * time))
        a = np.real(fused.phasors.value[k] * np.exp(2j * np.pi * frequency * time[1]))
        np.testing.assert_allclose((x[0] - 2.0 * x[1] + x[2]) / h**2, a, rtol=1e-5, atol=1e-6 * np.abs(a).max())
    motion = evaluation_scene(demo_evaluation).data()["motions"][0]
    phasors = np.array(motion["r"]["load"]).reshape(6, 2) @ [1.0, 1.0j]
    expected = -fused.phasors.value[0] / (2.0 * np.pi * fused.phasors.frequency_hz[0]) ** 2
    np.testing.assert_allclose(phasors * 1e-6, expected, rtol=5e-5)


def test_the_text_of_a_line_is_its_amplitude_with_uncertainty(demo_evaluation):
    scene = evaluation_scene(demo_evaluation)
    fused = next(a for a in demo_evaluation.accelerations if (a.body, a.source) == ("load", "fused"))
    value, square = fused.phasors.value[0, 2], (2.0 * np.pi * fused.phasors.frequency_hz[0]) ** 2
    size, u, phase = re.fullmatch(
        r"load z: \((\S+) ± (\S+)\) µm at (\S+)° \(k = \S+\)", scene.motions[0].amplitudes[0]
    ).groups()
    assert float(size) == pytest.approx(1e6 * abs(value) / square, abs=float(u))
    assert float(phase.replace("\N{MINUS SIGN}", "-")) == pytest.approx(np.degrees(np.angle(-value)), abs=0.06)
    assert [motion.name.partition(",")[2] for motion in scene.motions] == ["", " harmonic 2", " harmonic 3"]


def test_only_a_significant_deflection_is_drawn(demo_evaluation):
    scene = evaluation_scene(demo_evaluation)
    assert not any(motion.deflection for motion in scene.motions)  # the simulated load is rigid
    assert any(" top " in amplitude for amplitude in scene.motions[0].amplitudes)
    top, *others = demo_evaluation.stereo
    shape = top.deflection
    bend = 2e-5j * (shape.reference_m[:, 0] / 0.04) ** 2
    value = shape.value.copy()
    value[1, :, 2] += bend
    bent = replace(top, deflection=DeflectionShape(shape.frequency_hz, shape.reference_m, value, shape.u))
    scene = evaluation_scene(replace(demo_evaluation, stereo=(bent, *others)))
    assert [sorted(motion.deflection) for motion in scene.motions] == [[], ["top"], []]
    drawn = shape_of(scene, "points of top")
    assert 3 <= len(drawn.points_m) <= MOST_POINTS
    found = scene.motions[1].deflection["top"][:, 2]
    expected = 2e-5j * (drawn.points_m[:, 0] / 0.04) ** 2
    assert np.abs(found - expected).max() < 5.0 * np.nanmax(shape.u)
    page = scene_page(scene)
    assert page.deflects
    assert len(page.json) + len(page.views) < 60_000


# The page.


def test_names_are_escaped_everywhere(manifest):
    named = with_channel(manifest, "velocity_1", name=NASTY)
    named = replace(named, name=NASTY, rig=manifest.rig.model_copy(update={"name": NASTY}))
    page = rig_page([named])
    found = self_contained(page)
    assert "<img" not in page
    assert "\u2028" not in scene_page(rig_scene(named)).json
    assert page.count("</script>") == 2
    assert NASTY in "".join(found.text)
    data = json.loads(re.search(r'<script type="application/json">(.*?)</script>', page, re.S)[1])
    assert NASTY in [shape["n"] for shape in data["shapes"]]


def test_the_static_image_has_three_views_to_one_scale(manifest):
    """A cube of 100 mm is a square of the same size in every view."""
    corners = np.array([(x, y, z) for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)])
    cube = SceneShape("load", "cube", "", corners, faces=((0, 1, 3, 2),), closed=True, fill=1.0)
    root = ElementTree.fromstring(static_views([cube]))
    shown = [e for e in root if "fill" in e.get("class", "")]
    sizes = [np.ptp(places(e), axis=0) for e in shown]
    assert len(sizes) == 3
    np.testing.assert_allclose(sizes, sizes[0][0], atol=0.11)
    whole = ElementTree.fromstring(scene_page(rig_scene(manifest)).views)
    labels = [e for e in whole if "label" in e.get("class", "")]
    assert {"top left", "base right", "x", "z", "velocity_1"} <= {e.text for e in labels}
    boxes = [(float(e.get("x")), float(e.get("y")), 6.0 * len(e.text)) for e in labels]
    for k, (x, y, width) in enumerate(boxes):
        assert not any(abs(y - v) < 11 and x < u + w and u < x + width for u, v, w in boxes[:k])


def places(path: ElementTree.Element) -> np.ndarray:
    return np.array([[float(x) for x in place.split()] for place in path.get("d", "")[1:-1].split("L")])


def test_check_draws_the_rig_and_replaces_files_only_by_force(demo_recording, tmp_path, capsys):
    file = tmp_path / "rig.html"
    assert main(["check", str(demo_recording), "--rig", str(file)]) == 0
    assert str(file) in capsys.readouterr().out
    text = file.read_text(encoding="utf-8")
    assert re.search(r"<figure class=\"scene\">", text)
    self_contained(text)
    file.write_text("mine", encoding="utf-8")
    assert main(["check", str(demo_recording), "--rig", str(file)]) == 2
    assert file.read_text(encoding="utf-8") == "mine"
    assert main(["check", str(demo_recording), "--rig", str(file), "--force"]) == 0
    with pytest.raises(SystemExit) as ended:
        main(["check", str(demo_recording), "--rig", str(tmp_path / "rig.svg")])
    assert ended.value.code == 2
    assert ".html" in capsys.readouterr().err


# In a browser.


def written(path: Path, scene: Scene) -> Path:
    """A page with one scene."""
    context = {"rig": "rig", "scenes": [("recording", scene_page(scene))], "program": "shakercal"}
    path.write_text(render_page("rig.html", context), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def moving(demo_evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("scene") / "page.html", evaluation_scene(demo_evaluation))


@pytest.fixture
def opened(browser, moving, request) -> Iterator[Page]:
    page = Page(browser, moving, **getattr(request, "param", {}))
    page.page.wait_for_timeout(300)
    yield page
    page.close()


def pixels(opened: Page) -> np.ndarray:
    """What stands on the canvas: rows, columns, red, green, blue and opacity."""
    opened.page.wait_for_timeout(120)
    url = opened.page.evaluate("() => document.querySelector('canvas').toDataURL()")
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED)
    return picture[..., [2, 1, 0, 3]]


STILL = {"reduced_motion": "reduce"}


@pytest.mark.parametrize("opened", [{"color_scheme": "light"}, *slow({"color_scheme": "dark"})], indirect=True)
def test_it_plays_until_it_is_paused_and_goes_on(opened):
    first = pixels(opened)
    assert np.count_nonzero(first[..., 3]) > 20_000
    assert opened.page.locator("[data-part=play]").text_content() == "Pause"
    assert np.count_nonzero(first != pixels(opened)) > 1000
    opened.page.locator("[data-part=play]").click()
    still = pixels(opened)
    assert np.array_equal(still, pixels(opened))
    opened.page.get_by_role("button", name="A step of 15° on").click()
    assert not np.array_equal(still, pixels(opened))
    opened.page.locator("canvas").press(" ")
    assert not np.array_equal(pixels(opened), pixels(opened))
    assert opened.page.locator("[data-part=play]").text_content() == "Pause"


@pytest.mark.parametrize("opened", [STILL], indirect=True)
def test_whoever_wants_no_motion_starts_paused_and_turns_it_by_keys(opened):
    first = pixels(opened)
    assert np.array_equal(first, pixels(opened))
    canvas = opened.page.locator("canvas")
    canvas.press("ArrowLeft")
    turned = pixels(opened)
    assert np.count_nonzero(first != turned) > 1000
    canvas.press("ArrowRight")
    assert np.count_nonzero(np.abs(first.astype(int) - pixels(opened)) > 16) < 50
    canvas.press("+")
    assert np.count_nonzero(first != pixels(opened)) > 1000
    nearer, box = pixels(opened), canvas.bounding_box()
    opened.page.mouse.move(box["x"] + 20, box["y"] + 20)
    opened.page.mouse.wheel(0, -200)
    assert np.count_nonzero(nearer != pixels(opened)) > 1000
    opened.page.get_by_role("button", name="Seen from above").focus()
    opened.page.keyboard.press("Enter")
    assert np.count_nonzero(turned != pixels(opened)) > 1000
    opened.page.get_by_label("cameras").uncheck()
    blue = np.count_nonzero(np.abs(pixels(opened)[..., :3].astype(int) - (0x00, 0x72, 0xB2)).sum(axis=2) < 12)
    assert blue == 0


@pytest.mark.parametrize("opened", [STILL], indirect=True)
def test_pointing_at_a_shape_shows_its_name_and_position(opened):
    opened.page.get_by_role("button", name="Seen along +y").click()
    seen, box, found = pixels(opened), opened.page.locator("canvas").bounding_box(), set()
    red = np.argwhere(np.abs(seen[..., :3].astype(int) - (0xD5, 0x5E, 0x00)).sum(axis=2) + 255 - seen[..., 3] < 8)
    middle = np.array(seen.shape[:2]) / 2.0
    beside = middle + np.stack([np.arange(-90.0, 90.0, 15.0), np.full(12, 40.0)], axis=1)
    for y, x in np.concatenate([red[:: max(len(red) // 60, 1)], middle[None], beside]).tolist():
        opened.page.mouse.move(box["x"] + x, box["y"] + y)
        found.add(opened.page.locator("[data-part=tip]").inner_text())
    shown = "\n".join(found)
    for part in ("velocity_1", "(33.0, 0.0, 69.0) mm", "(0.000, 0.000, 1.000)", "2.4063 kg", "(0.0, 0.0, 38.5) mm"):
        assert part in shown


def test_the_drawn_motion_is_the_real_part_of_the_phasor(browser, tmp_path):
    """x(t) = sin ωt along z of one dot; of another, at x = 50 mm, the turn θ·cos ωt about y: z = -θ·x."""
    dots = {
        "load": (0.0, 0.0, 0.0),
        "base": (0.05, 0.0, 0.0),
        "camera": (-0.05, 0.0, 0.05),
        "gravity": (-0.05, 0.0, -0.05),
    }
    shapes = [
        SceneShape(kind, kind, "", np.array([at]), dots="one", body=kind if kind in ("load", "base") else "")
        for kind, at in dots.items()
    ]
    rigid = {"load": np.zeros(6, np.complex128), "base": np.zeros(6, np.complex128)}
    rigid["load"][2], rigid["base"][4] = -1e-6j, 2e-5
    opened = Page(
        browser,
        written(tmp_path / "dots.html", Scene("dots", tuple(shapes), (SceneMotion("1 Hz", 1.0, (), rigid),))),
        **STILL,
    )
    page = opened.page
    page.get_by_role("button", name="Show everything").click()
    page.get_by_role("button", name="Seen along +y").click()
    size = SceneMotion("", 1.0, (), rigid)
    factor = json.loads(scene_page(Scene("dots", tuple(shapes), (size,))).json)["motions"][0]["m"][0]
    colours = {"load": (230, 159, 0), "base": (122, 122, 122), "camera": (0, 114, 178), "gravity": (204, 121, 167)}

    def heights() -> dict[str, float]:
        seen = pixels(opened).astype(int)
        rows = {
            kind: np.nonzero(np.abs(seen[..., :3] - c).sum(axis=2) + 255 - seen[..., 3] < 8)[0]
            for kind, c in colours.items()
        }
        return {kind: float(found.mean()) for kind, found in rows.items()}

    for degrees in (0, 90, 180, 250):
        page.locator("[data-part=phase]").fill(str(degrees))
        at = heights()
        mm = (at["gravity"] - at["camera"]) / 100.0
        angle, middle = np.radians(degrees), (at["gravity"] + at["camera"]) / 2.0
        assert (middle - at["load"]) / mm == pytest.approx(1e-3 * factor * np.sin(angle), abs=0.7)
        expected = -50.0 * np.sin(2e-5 * factor * np.cos(angle))
        assert (middle - at["base"]) / mm == pytest.approx(expected, abs=0.7)
    opened.close()


def test_names_are_text_in_the_browser_and_without_programs_the_views_remain(browser, manifest, tmp_path):
    path = written(tmp_path / "page.html", rig_scene(with_channel(manifest, "velocity_1", name=NASTY)))
    opened = Page(browser, path, **STILL)
    assert not opened.page.locator(".still").is_visible()
    opened.page.emulate_media(media="print")
    assert opened.page.locator(".still").is_visible()
    assert not opened.page.locator("canvas").is_visible()
    opened.close()
    plain = browser.new_context(java_script_enabled=False)
    page = plain.new_page()
    page.goto(path.as_uri())
    assert page.locator(".still svg").is_visible()
    assert not page.locator("canvas").is_visible()
    plain.close()


def test_a_scene_of_axes_only_is_drawn(browser, tmp_path):
    nothing = SimpleNamespace(part=(), set_ups=[], name="nothing")
    rig = SimpleNamespace(load=None, sensor=None, stereo={}, surroundings=SimpleNamespace(free_fall_mps2=(None, None)))
    nothing.rig = rig
    opened = Page(browser, written(tmp_path / "page.html", rig_scene(nothing)), **STILL)
    assert np.count_nonzero(pixels(opened)[..., 3]) > 500
    opened.close()


def test_pixels_of_the_image_move_as_the_body_does(demo_evaluation, manifest):
    """The flow of the mesh against what the camera sees of tracked points that are turned and displaced."""
    stated, (item, *_) = manifest.rig.stereo, [one for one in demo_evaluation.stereo if one.body == "load"]
    motion = np.array([3e-5, -2e-5, 5e-5, 2e-4, -1e-4, 3e-4]) * np.exp(1j * np.arange(6))
    (image,) = moving_images([item], stated, {"load": motion[None]})
    data = json.loads(image.json)
    nodes, flow = np.reshape(data["at"], (-1, 2)), np.reshape(data["flow"][0], (-1, 2, 2)) @ (1.0, 1j)
    scale = image.width / item.reference_image.shape[1]
    rest = item.deflection.reference_m[np.isfinite(item.deflection.reference_m).all(axis=1)]
    camera, pose = read_rig(stated["top"], ()).camera_poses[0][0], sensor_from_camera(stated["top"])
    seen_at = [
        scale * camera.project(pose.inverse().apply(Rotation.from_rotvec(x[3:]).apply(rest) + x[:3]))
        for x in (np.zeros(6), motion.real, motion.imag)
    ]
    moved = (seen_at[1] - seen_at[0]) + 1j * (seen_at[2] - seen_at[0])
    nearest = np.argmin(np.linalg.norm(nodes[:, None] - seen_at[0], axis=2), axis=1)
    near = np.linalg.norm(nodes - seen_at[0][nearest], axis=1) < 4.0
    assert near.sum() > 30
    largest = np.abs(moved).max()
    assert np.abs(flow[near] - moved[nearest[near]]).max() < 0.03 * largest
    assert np.all(np.abs(flow[[0, 24, -25, -1]]) < 0.5 * largest), "the corners lie beside the tracked points"
    assert data["size"][0] * np.abs(flow).max() == pytest.approx(0.025 * image.width, rel=0.05)


def test_the_image_moves_with_the_scene(demo_evaluation, browser, tmp_path):
    page = tmp_path / "report.html"
    page.write_text(render_report(demo_evaluation), encoding="utf-8")
    opened = Page(browser, page, **STILL)
    canvas, shots = opened.page.locator("figure.moving canvas").first, {}
    for degrees in (0, 90, 180, 0):
        opened.page.locator("[data-part=phase]").fill(str(degrees))
        opened.page.wait_for_timeout(100)
        shot = canvas.evaluate("one => one.toDataURL()")
        assert shots.setdefault(degrees, shot) == shot
    assert len(set(shots.values())) == 3
    opened.page.emulate_media(media="print")
    assert opened.page.locator("figure.moving img").first.is_visible()
    opened.close()
