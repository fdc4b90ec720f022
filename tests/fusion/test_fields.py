"""Fields over the images: values against truth and sampled noise; files read back; the page in a browser."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import h5py
import numpy as np
import pytest
from browsing import Page
from contracts import slow
from PIL import Image
from support import complex_of, truth_of

from fusion.cli import main
from fusion.phasors.deformation import ShapePhasors
from fusion.recording.load import find_recordings
from fusion.report.field_data import (
    PairField,
    PointShapes,
    field_quantities,
    finite_points,
    pair_fields,
    principal_direction,
    read_pair_fields,
)
from fusion.report.field_export import export_fields
from fusion.report.field_images import MOST_POINTS, decimate_points, field_page, overlay, scale_ends, value_scale
from fusion.report.motion_figures import tracked_surface
from fusion.report.recording_report import render_report
from fusion.report.report_notices import FIELD_FOLDER_EXISTS, NO_FIELDS, NO_RESULTS
from fusion.report.report_scene import evaluation_scene
from photogram.geometry import displacement_jacobian
from shaker.sine.phasor import Phasors

FRAMES, LINES = 40, 2


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(55)


def made_field(rng: np.random.Generator, side: int = 6, u: float = 3e-8) -> PairField:
    """A square face that moves as a rigid body, with noise of every subset and of the motion."""
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2).astype(float)
    points = np.column_stack([0.01 * grid - 0.02, np.full(len(grid), 0.05)])
    rigid = 1e-6 * (rng.standard_normal((LINES, 6)) + 1j * rng.standard_normal((LINES, 6))) * [1, 1, 9, 20, 20, 20]
    root = rng.standard_normal((LINES, 12, 12)) * np.tile([2e-9, 2e-9, 2e-9, 1e-7, 1e-7, 1e-7], 2)[:, None]
    u_deviation = u * rng.uniform(0.5, 1.5, (LINES, len(grid), 3))
    noise = rng.standard_normal((2, LINES, len(grid), 3))
    return PairField(
        *("top", "load", np.array([80.0, 160.0]), 20.0 * grid + 40.0, points, rigid),
        covariance=root @ root.swapaxes(1, 2),
        deviation=u_deviation * (noise[0] + 1j * noise[1]),
        u_deviation=u_deviation,
        zncc=rng.uniform(0.99, 1.0, len(grid)),
        image=rng.integers(0, 255, (200, 220), dtype=np.uint8),
        pixels_per_px=1.0,
        driven=np.array([0.0, 0.0, 1.0]),
        frames=FRAMES,
    )


def named(pair: PairField, line: int = 0) -> dict[str, Any]:
    return {quantity.key: quantity for quantity in field_quantities(pair, line)}


# Values and their U.


def test_u_of_amplitude_and_phase_is_the_scatter_of_sampled_fields(rng):
    pair, draws = made_field(rng), 4000
    found = named(pair)["d-z"]
    root = np.linalg.cholesky(pair.covariance[0] + 1e-40 * np.eye(12))
    parts = rng.standard_normal((draws, 12)) @ root.T
    rigid = pair.rigid[0] + parts[:, :6] + 1j * parts[:, 6:]
    drawn = np.einsum("nm,dm->dn", displacement_jacobian(pair.reference_m)[:, 2], rigid)
    noise = pair.u_deviation[0, :, 2] * rng.standard_normal((2, draws, len(pair.points_px)))
    drawn = drawn + pair.deviation[0, :, 2] + noise[0] + 1j * noise[1]
    np.testing.assert_allclose(np.mean(drawn, axis=0), found.value, atol=3e-9)
    np.testing.assert_allclose(2.0 * np.abs(drawn).std(axis=0), found.expanded, rtol=0.08)
    across = np.abs(found.value) * np.angle(drawn * np.conj(found.value)).std(axis=0)
    np.testing.assert_allclose(2.0 * across, found.across, rtol=0.08)


def test_the_largest_displacement_is_that_of_the_whole_period(rng):
    phasors = rng.standard_normal((30, 3)) + 1j * rng.standard_normal((30, 3))
    direction = principal_direction(phasors, np.array([0.0, 0.0, 1.0]))
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 7201))
    largest = np.linalg.norm((phasors[..., None] * turn).real, axis=1).max(axis=1)
    np.testing.assert_allclose(np.abs(np.einsum("nc,nc->n", direction, phasors)), largest, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)
    assert np.all(direction[:, 2] >= 0.0)


def test_noise_alone_leaves_five_per_cent_of_the_points_above_it(rng):
    """Frames of white noise, fitted as the deflection is: the share above the noise is that of its level."""
    time, count, hertz = np.arange(FRAMES) / 52.9, 4000, np.array([80.0, 160.0])
    columns = np.column_stack(
        [part for f in hertz for part in (np.cos(2 * np.pi * f * time), -np.sin(2 * np.pi * f * time))]
        + [np.ones(FRAMES)]
    )
    series = rng.standard_normal((FRAMES, count))
    solved, rest, *_ = np.linalg.lstsq(columns, series, rcond=None)
    inverse = np.linalg.inv(columns.T @ columns)
    sigma = np.sqrt(rest / (FRAMES - columns.shape[1]))
    u = sigma * np.sqrt((inverse[0, 0] + inverse[1, 1]) / 2.0)
    pair = made_field(rng)
    pair = replace(
        pair,
        points_px=rng.uniform(0, 500, (count, 2)),
        reference_m=np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)), np.zeros(count)]),
        deviation=np.tile((solved[0] + 1j * solved[1])[None, :, None], (LINES, 1, 3)),
        u_deviation=np.tile(u[None, :, None], (LINES, 1, 3)),
        zncc=None,
    )
    assert named(pair)["r-z"].above_noise.mean() == pytest.approx(0.05, abs=0.012)


def test_the_demo_moves_as_its_truth_does(demo_evaluation, demo_recording):
    truth = truth_of(find_recordings(demo_recording)[0].parent)
    for pair in pair_fields(demo_evaluation):
        true = -complex_of(truth["acceleration"][pair.body])[0] / (2.0 * np.pi * pair.frequency_hz[0]) ** 2
        moved, quantities = displacement_jacobian(pair.reference_m) @ true, named(pair)
        for axis, name in enumerate("xyz"):
            found = quantities[f"d-{name}"]
            off = np.abs(found.value - moved[:, axis]) / np.hypot(found.expanded, found.across) * np.sqrt(8.0)
            assert np.quantile(off, 0.9) < 3.0, "in standard uncertainties of a part"
            assert found.kind == "measured"
        assert quantities["m-z"].kind == "model"
        assert quantities["r-z"].above_noise.mean() < 0.2, "a rigid body"
        assert np.all((quantities["zncc"].value > 0.99) & (quantities["zncc"].value < 1.0))
        assert "driven direction" in quantities["d-z"].label


def test_shapes_are_a_quantity_where_they_are_significant(rng):
    pair = made_field(rng)
    form = np.zeros((1, 36, 3))
    form[0, :, 2] = (pair.reference_m[:, 0] / 0.03) ** 2
    value, covariance = np.array([[4e-7j], [1e-9]]), np.tile(2e-9**2 * np.eye(2), (2, 1, 1))
    shapes = PointShapes(form, value, covariance, ("plate: mode 1",))
    found = named(replace(pair, shapes=shapes))["b-z"]
    np.testing.assert_allclose(found.value, 4e-7j * form[0, :, 2])
    np.testing.assert_allclose(found.expanded, 4e-9 * form[0, :, 2], rtol=1e-9)
    assert found.kind == "shapes"


def test_points_that_are_not_finite_are_left_out(rng):
    pair = made_field(rng)
    deviation = pair.deviation.copy()
    deviation[1, 5, 2] = np.nan
    assert len(finite_points(replace(pair, deviation=deviation)).points_px) == 35
    assert finite_points(replace(pair, reference_m=np.full((36, 3), np.nan))) is None
    assert np.array_equal(pair.triangles, replace(pair).triangles)
    holed = np.delete(np.arange(36), [14, 15, 20, 21])
    around = pair.without_points(np.isin(np.arange(36), holed))
    corners = around.points_px[around.triangles]
    area = np.abs(np.linalg.det(np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1))) / 2
    assert area.sum() == pytest.approx((25 - 9) * 400.0 + 4 * 200.0, abs=0.5), "a hole is no surface"


# Colours.


def test_colours_are_linear_between_points_and_end_at_the_surface(rng):
    pair = made_field(rng)
    values = 1e-6 * (1.0 + pair.points_px[:, 0])
    scale = value_scale(values, np.zeros(36), "m")
    shown = overlay(np.zeros((200, 220), np.uint8), pair.points_px, pair.triangles, values, scale)
    assert not shown[:39].any()
    assert not shown[:, :39].any()
    assert shown[60, 45:135].any(axis=1).all()
    assert scale_ends(scale) == ("41", "141")
    column = shown[50:130, 90].astype(int)
    assert np.ptp(column, axis=0).max() <= 1
    single = np.where(np.arange(36) == 7, values, np.nan)
    squares = overlay(np.zeros((200, 220), np.uint8), pair.points_px, pair.triangles, single, scale, 18.0)
    x, y = pair.points_px[7].astype(int)
    assert squares[y, x].any()
    assert np.count_nonzero(squares.any(axis=2)) == 18 * 18


def test_a_range_narrower_than_u_is_widened():
    values = np.array([1.0e-6, 1.1e-6])
    scale = value_scale(values, np.full(2, 4e-7), "m")
    assert scale.high - scale.low == pytest.approx(4e-7)
    assert scale_ends(scale) == ("0.85", "1.25")
    assert scale_ends(value_scale(values, np.zeros(2), "m", signed=True)) == ("\N{MINUS SIGN}1.1", "1.1")


def test_a_page_thins_many_points():
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(50)), axis=-1).reshape(-1, 2) * 17.0
    kept = decimate_points(grid, 17.0)
    assert 100 < kept.sum() <= MOST_POINTS
    assert np.diff(np.unique(grid[kept][:, 0])).max() == 34.0


# The page.


def decoded(text: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(columns, -1)


def test_numbers_of_the_page_are_those_of_the_results(demo_evaluation):
    pairs = pair_fields(demo_evaluation)
    page = field_page(pairs, demo_evaluation.stereo, [])
    assert [figure.body for figure in page.figures] == ["load", "base"]
    for pair, figure in zip(pairs, page.figures, strict=True):
        data = json.loads(figure.json)
        scale = data["scale"]
        points = decoded(data["points"], len(pair.points_px))
        np.testing.assert_allclose((points + 0.5) / scale - 0.5, pair.points_px, atol=0.02)
        assert figure.source.startswith("data:image/jpeg")
        for line in range(len(pair.frequency_hz)):
            shown = {quantity["key"]: quantity for quantity in data["quantities"]}
            for one in field_quantities(pair, line):
                entry = shown[one.key]["lines"][line]
                factor = {"": 1.0, "m": 1.0, "mm": 1e-3, "µm": 1e-6, "nm": 1e-9, "pm": 1e-12}[entry["unit"]]
                columns = 2 if one.across is None else 4 + (one.noise is not None)
                numbers = factor * decoded(entry["values"], columns)
                np.testing.assert_allclose(numbers[0], one.value.real, rtol=1e-6)
                if one.across is not None:
                    np.testing.assert_allclose(numbers[1], one.value.imag, rtol=1e-6)
                    np.testing.assert_allclose(numbers[3], one.across, rtol=1e-6)
                np.testing.assert_allclose(numbers[1 if one.across is None else 2], one.expanded, rtol=1e-6)
    assert page.lines[0].startswith("80.0")
    assert len(render_report(demo_evaluation)) < 2_500_000


def test_no_images_no_section(demo_evaluation):
    pairs = (replace(one, subsets_px=None, reference_image=None) for one in demo_evaluation.stereo)
    without = replace(demo_evaluation, stereo=tuple(pairs))
    assert not pair_fields(without)
    assert 'class="fields"' not in render_report(without)


# Files.


@pytest.fixture(scope="module")
def exported(demo_results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fields")
    assert main(["export", str(demo_results), "--fields", str(folder)]) == 0
    return folder


def vtk_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of a VTK file, read as the format's description has it: a length of 8 bytes, then numbers."""
    kinds = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}
    found = {}
    for one in ElementTree.parse(path).getroot().iter("DataArray"):
        raw = base64.b64decode(one.text)
        assert int.from_bytes(raw[:8], "little") == len(raw) - 8
        values = np.frombuffer(raw[8:], kinds[one.attrib["type"]])
        columns = int(one.attrib.get("NumberOfComponents", 1))
        found[one.attrib["Name"]] = values.reshape(-1, columns) if columns > 1 else values
    return found


def test_results_hold_the_fields_of_the_evaluation(demo_evaluation, demo_results):
    with h5py.File(demo_results / "result.h5") as file:
        stored = read_pair_fields(file)
    for one, other in zip(pair_fields(demo_evaluation), stored, strict=True):
        for line in range(len(one.frequency_hz)):
            for first, second in zip(field_quantities(one, line), field_quantities(other, line), strict=True):
                assert (first.key, first.label) == (second.key, second.label)
                np.testing.assert_allclose(first.value, second.value, rtol=1e-9)
                np.testing.assert_allclose(first.expanded, second.expanded, rtol=1e-9)
        assert other.image.dtype == np.uint8


def test_vtk_has_the_phasors_of_the_points(demo_evaluation, exported):
    for pair in pair_fields(demo_evaluation):
        for line, hertz in enumerate(pair.frequency_hz):
            arrays = vtk_arrays(exported / f"{pair.name}-{hertz:.4f}Hz.vtp")
            moved = displacement_jacobian(pair.reference_m) @ pair.rigid[line] + pair.deviation[line]
            np.testing.assert_array_equal(arrays["place_m"], pair.reference_m)
            np.testing.assert_allclose(arrays["displacement_re_m"] + 1j * arrays["displacement_im_m"], moved)
            np.testing.assert_array_equal(arrays["u_deviation_m"], pair.u_deviation[line])
            np.testing.assert_array_equal(arrays["zncc"], pair.zncc)
            np.testing.assert_array_equal(arrays["image_px"][:, :2], pair.points_px)
            assert np.all(arrays["u_displacement_m"] >= 0.999 * arrays["u_deviation_m"])
            corners = arrays["connectivity"].reshape(-1, 3)
            assert arrays["offsets"].tolist() == list(range(3, 3 * len(corners) + 1, 3))
            assert corners.max() == len(pair.reference_m) - 1
    listed = ElementTree.parse(exported / "top-lines.pvd").getroot().iter("DataSet")
    assert [float(one.attrib["timestep"]) for one in listed] == pair_fields(demo_evaluation)[0].frequency_hz.tolist()


def test_images_show_the_field_and_move(exported):
    """Half a period later the body is on the other side: other colours; after a whole one it is as before."""
    still = cv2.imread(str(exported / "top-80.0002Hz-d-z.png"))
    assert still.std() > 30.0
    moving = Image.open(exported / "top-80.0002Hz-d-z.webp")
    assert moving.n_frames == 24
    shots = []
    for step in (0, 6, 12, 18):
        moving.seek(step)
        shots.append(np.asarray(moving.convert("RGB"), dtype=float)[200:400, 200:400])
    middles = np.array([shot.mean(axis=(0, 1)) for shot in shots])
    red_less_blue = middles[:, 0] - middles[:, 2]
    assert red_less_blue[0] * red_less_blue[2] < 0.0
    assert red_less_blue[1] * red_less_blue[3] < 0.0
    film = cv2.VideoCapture(str(exported / "top-80.0002Hz-d-z.mp4"))
    count = 0
    while film.read()[0]:
        count += 1
    assert count in (0, 72), "0 where the system writes no film"
    assert (exported / "fields.txt").read_text(encoding="utf-8").count("pair ") == 2


def with_pairs(results: Path, folder: Path, *imaged: str) -> Path:
    """A copy of results in which only some pairs have an image."""
    folder.mkdir(parents=True)
    (folder / "result.h5").write_bytes((results / "result.h5").read_bytes())
    with h5py.File(folder / "result.h5", "a") as file:
        for pair in {*file["stereo"]} - {*imaged}:
            del file[f"stereo/{pair}/first_image"]
    return folder


def test_an_export_replaces_only_its_files_and_only_by_force(demo_results, tmp_path, capsys):
    results, exported = with_pairs(demo_results, tmp_path / "of" / "one"), tmp_path / "exported"
    assert main(["export", str(results), "--fields", str(exported)]) == 0
    assert main(["export", str(results), "--fields", str(exported)]) == 2
    assert FIELD_FOLDER_EXISTS.code in capsys.readouterr().err
    for name in ("mine.txt", "top-notes.png"):
        (exported / name).write_text("mine", encoding="utf-8")
    (exported / "top-79.0000Hz-d-z.png").write_text("of an earlier export", encoding="utf-8")
    names = {path.name for path in exported.iterdir()} - {"top-79.0000Hz-d-z.png"}
    assert main(["export", str(results), "--fields", str(exported), "--force"]) == 0
    assert {path.name for path in exported.iterdir()} == names
    assert main(["export", str(tmp_path), "--fields", str(tmp_path / "new")]) == 2
    assert NO_RESULTS.code in capsys.readouterr().err
    with h5py.File(tmp_path / "result.h5", "w") as file:
        file.attrs["format"] = 1
    assert main(["export", str(tmp_path), "--fields", str(tmp_path / "new")]) == 2
    assert NO_FIELDS.code in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    with pytest.raises(SystemExit):
        main(["export", str(results)])


def test_a_campaign_writes_the_fields_of_every_recording(demo_results, tmp_path, monkeypatch):
    monkeypatch.setattr("fusion.report.field_export.FRAMES", 2)
    with_pairs(demo_results, tmp_path / "campaign" / "one", "top")
    with_pairs(demo_results, tmp_path / "campaign" / "two")
    written = {path.name for path in export_fields(tmp_path / "campaign", tmp_path / "out")}
    assert "one-top-80.0002Hz-d-z.png" in written
    assert "two-top-80.0002Hz.vtp" in written
    assert not any(name.startswith("two-") and name.endswith(".png") for name in written), "results without an image"


# Measured bending in space.


def test_bending_is_drawn_by_its_shape_and_named_with_a_colon(demo_evaluation):
    top, *others = demo_evaluation.stereo
    points = top.deflection.reference_m
    form = np.zeros((1, len(points), 3))
    form[0, :, 2] = (points[:, 0] / 0.04) ** 2
    value = np.zeros((len(top.deflection.frequency_hz), 1), complex)
    value[0] = 380e-9j
    u = np.tile(8e-9**2 * np.eye(2), (len(value), 1, 1))
    channels = ("plate: mode 1",)
    phasors = Phasors(top.deflection.frequency_hz, value, u, channels, ("m",), np.full(len(value), 200.0))
    chance = np.where(np.arange(len(value)) == 0, 1e-9, 0.5)
    none = np.zeros((0, len(value), 1), complex)
    shapes = ShapePhasors(phasors, none, np.zeros((6, 1)), chance, chance, 1, form)
    scene = evaluation_scene(replace(demo_evaluation, stereo=(replace(top, shapes=shapes), *others)))
    texts = " | ".join(scene.motions[0].amplitudes)
    assert "top, plate: mode 1: (380 ± 16) nm (k = 2)" in texts
    assert "mode 1" not in " ".join(scene.motions[1].amplitudes)
    (surface,) = tracked_surface(replace(top, shapes=shapes))
    np.testing.assert_allclose(scene.motions[0].deflection["top"], 380e-9j * form[0][surface.shown])
    assert not scene.motions[1].deflection


def test_points_below_their_noise_are_not_deflected(demo_evaluation):
    top = demo_evaluation.stereo[0]
    shape = top.deflection
    bent = np.abs(shape.reference_m[:, 0]) > 0.02
    value = np.where(bent[None, :, None], 30.0 * shape.u, 0.5 * shape.u).astype(complex)
    (surface,) = tracked_surface(replace(top, deflection=replace(shape, value=value), shapes=None))
    drawn = surface.deflection(0)
    np.testing.assert_array_equal(np.abs(drawn).max(axis=1) > 0.0, bent[surface.shown])


# In a browser.


@pytest.fixture(scope="module")
def page_file(demo_evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_report(demo_evaluation), encoding="utf-8")
    return path


@pytest.fixture
def opened(browser, page_file, request) -> Iterator[Page]:
    page = Page(browser, page_file, **getattr(request, "param", {}))
    page.page.locator(".fields figure[data-drawn]").nth(1).wait_for()
    yield page
    page.close()


def field(opened: Page, name: str) -> Any:
    return opened.page.locator(f".fields [data-field={name}]")


def canvas_pixels(opened: Page) -> np.ndarray:
    url = field(opened, "canvas").first.evaluate("one => one.toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"), dtype=int)


@pytest.mark.parametrize("opened", [{"color_scheme": "light"}, *slow({"color_scheme": "dark"})], indirect=True)
def test_the_probe_reads_value_u_and_unit(opened, demo_evaluation):
    pair = pair_fields(demo_evaluation)[0]
    canvas, probe, found = field(opened, "canvas").first, field(opened, "probe").first, named(pair)["d-z"]
    box = canvas.bounding_box()
    scale = box["width"] / demo_evaluation.stereo[0].reference_image.shape[1]
    at = int(np.argmin(np.linalg.norm(pair.points_px - pair.points_px.mean(axis=0), axis=1)))
    x, y = scale * (pair.points_px[at] + 0.5)
    canvas.hover(position={"x": float(x) + 1.0, "y": float(y)})
    value, expanded = re.search(r": ([\d.]+) ± ([\d.]+) µm", probe.inner_text()).groups()
    assert float(value) == pytest.approx(1e6 * abs(found.value[at]), abs=10.0 ** -len(value.partition(".")[2]))
    assert float(expanded) == pytest.approx(1e6 * found.expanded[at], rel=0.05)
    assert len(expanded.replace(".", "").lstrip("0")) == 2
    before = probe.inner_text()
    canvas.focus()
    opened.page.keyboard.press("ArrowRight")
    assert probe.inner_text() != before
    opened.page.keyboard.press("ArrowLeft")
    assert probe.inner_text() == before


def test_playing_changes_the_colours_until_it_is_paused(opened):
    first = canvas_pixels(opened)
    field(opened, "play").click()
    seen = []
    for _ in range(6):  # at parts of a period that a busy machine chooses
        opened.page.wait_for_timeout(150)
        seen.append(canvas_pixels(opened))
    assert max(np.abs(one - first).max() for one in seen) > 40
    assert max(np.abs(one - other).max() for one, other in pairwise(seen)) > 20
    field(opened, "play").click()
    paused = canvas_pixels(opened)
    opened.page.wait_for_timeout(300)
    assert np.array_equal(canvas_pixels(opened), paused)
    assert field(opened, "view").input_value() == "now"


def test_quantities_scales_and_isolines_change_the_image(opened):
    shots = {"first": canvas_pixels(opened)}
    field(opened, "lines").check()
    shots["lines"] = canvas_pixels(opened)
    field(opened, "lines").uncheck()
    field(opened, "range").select_option("zero")
    shots["zero"] = canvas_pixels(opened)
    assert field(opened, "low").first.inner_text() == "0"
    field(opened, "range").select_option("fit")
    for key in ("r-z", "s-z", "zncc"):
        field(opened, "quantity").select_option(key)
        shots[key] = canvas_pixels(opened)
    assert "mean over the frames: score" in field(opened, "shown").first.inner_text()
    field(opened, "quantity").select_option("d-z")
    field(opened, "view").select_option("phase")
    shots["phase"] = canvas_pixels(opened)
    assert field(opened, "unit").first.inner_text() == "°"
    names = list(shots)
    for k, name in enumerate(names):
        assert all(not np.array_equal(shots[name], shots[other]) for other in names[:k]), name


def test_paper_has_the_field_without_controls(opened):
    opened.page.emulate_media(media="print")
    assert not field(opened, "play").is_visible()
    assert field(opened, "canvas").first.is_visible()
    assert field(opened, "high").first.is_visible()


def test_without_programs_the_field_is_a_still_image(browser, page_file):
    plain = browser.new_context(java_script_enabled=False)
    page = plain.new_page()
    page.goto(page_file.as_uri())
    assert page.locator(".fields img.still").first.is_visible()
    assert not page.locator(".fields .controls").is_visible()
    plain.close()
