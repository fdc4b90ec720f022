"""Recordings without images: another program's points, lasers and outputs, made from an analytic motion."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from contracts import refused, slow
from support import block, channel, evaluated, recording_head, write_daq
from take_factory import EXPOSURE_S, FREQUENCY_HZ, MASS_KG, RIG, SENSITIVITY, camera_trigger, moving_plate

from fusion.base import Settings
from fusion.errors import InputError
from fusion.estimation.fuse import Acceleration
from fusion.phasors.phasor_notices import EDGES_AMBIGUOUS
from fusion.report.recording_report import POINT_COLUMNS, write_results
from fusion.report.tables import acceleration
from fusion.sensitivity.analyse import Evaluation
from photogram.geometry import rotation_from_vector

OMEGA = 2 * np.pi * FREQUENCY_HZ
# Displacement phasors of the base and of the load at the sensor origin, m and rad.
BASE = np.array([4e-6 + 3e-6j, -2e-6, 2.4e-4 * np.exp(0.7j), 3e-5j, 2e-5 - 1e-5j, 1e-5])
LOAD = BASE * np.array([1.1, 1.1, 1.02 * np.exp(-0.03j), 1.0, 1.0, 1.0])
RATE_HZ, SAMPLES, FRAMES, DELAY_S = 20_000.0, 28_000, 64, 3e-6
# Pose of the points' frame, as the rig states it: x_sensor = R x + t.
ROTATION, TRANSLATION = np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, -0.05])

PAIR = block(
    "stereo.base", body="base", rotation=ROTATION.tolist(), translation=TRANSLATION.tolist(), exposure=EXPOSURE_S,
    pose_uncertainty=[1e-4] * 3 + [5e-4] * 3, scale_uncertainty=2e-4, delay=DELAY_S, delay_uncertainty=1e-6,
)  # fmt: skip
POINTS = block(
    "[points]", stereo="base", files="DIC_results/result_B*.txt", valid_status=3, scale=1e-3, trigger="camera_trigger",
    columns=["id_x", "id_y", "status", "status", "status", "x0", "y0", "z0", "x", "y", "z"],
)  # fmt: skip
STATED = {"point_uncertainty": 2e-4, "direction": [0.0, 0.0, 1.0], "scale": 0.125, "scale_uncertainty": 5e-4}


@dataclass(frozen=True)
class Campaign:
    """A recording that is being written: its folder, the text of its manifest, its channels, a source of noise."""

    folder: Path
    text: list[str]
    channels: dict[str, np.ndarray]
    rng: np.random.Generator

    def add_points(self) -> None:
        """Write the tables and the trigger; scale and pose err as the rig states."""
        (self.folder / "DIC_results").mkdir()
        moved = moving_plate(BASE, FRAMES, (8, 6), -0.03, DELAY_S)
        turn = rotation_from_vector(self.rng.normal(size=3) * 5e-4)
        shift, scale = self.rng.normal(size=3) * 1e-4, 1 + self.rng.normal() * 2e-4
        seen = (moved @ turn.T + shift - TRANSLATION) @ ROTATION * scale
        seen_mm = 1e3 * (seen + self.rng.normal(size=seen.shape) * [1e-6, 1e-6, 3e-6])
        at_rest = seen_mm[0].copy()
        for frame, points in enumerate(seen_mm):
            status = np.full((len(points), 3), 3)
            status[self.rng.random(len(points)) < 0.02, 1] = 5  # a facet that was lost: its numbers mean nothing
            points[(status != 3).any(axis=1)] = 0.0
            table = np.column_stack([np.indices((6, 8)).reshape(2, -1).T, status, at_rest, points])
            name = self.folder / "DIC_results" / f"result_B{frame}.txt"
            np.savetxt(name, table, fmt=["%d"] * 5 + ["%.6f"] * 6, delimiter="\t")
        self.channels["camera_trigger"] = camera_trigger(np.arange(SAMPLES) / RATE_HZ, FRAMES)
        self.text.extend([channel("camera_trigger", "trigger"), POINTS])

    def add_sensor(self, name: str, quantity: str, motion: tuple[str, np.ndarray], point: list[float]) -> None:
        """Write a laser or an accelerometer along z; several of one quantity are one instrument."""
        body, displacement = motion
        order = {"velocity": 1, "acceleration": 2}[quantity]
        at_point = displacement[2] + displacement[3] * point[1] - displacement[4] * point[0]
        self._add(name, (1j * OMEGA) ** order * at_point / 0.125 * (1 + 3e-4), 1e-4)
        own = {"common": "laser"} if quantity == "velocity" else {"transverse_sensitivity": 0.01}
        self.text.insert(1, channel(name, quantity, body=body, point=point, **STATED, **own))

    def add_output(self) -> None:
        """Write the sensor's output for the force that it exerts on the load."""
        self._add("Fz", 1e3 * SENSITIVITY * MASS_KG * -(OMEGA**2) * LOAD[2], 1e-5)
        self.text.insert(1, channel("Fz", "output", channel="Fz", scale=1e-3, scale_uncertainty=1e-4))

    def _add(self, name: str, phasor: complex, noise: float) -> None:
        time_s = np.arange(SAMPLES) / RATE_HZ
        signal = (phasor * np.exp(1j * OMEGA * time_s)).real
        self.channels[name] = signal + abs(phasor) * noise * self.rng.normal(size=SAMPLES)

    def evaluate(self) -> Evaluation:
        """Write the manifest and the channels, and evaluate the recording."""
        write_daq(self.folder / "daq.h5", RATE_HZ, self.channels)
        (self.folder / "recording.toml").write_text("".join(self.text), encoding="utf-8")
        return evaluated(self.folder)


@pytest.fixture
def campaign(tmp_path: Path, request: pytest.FixtureRequest) -> Campaign:
    folder = tmp_path / "campaign" / "Fz-0106.25"
    folder.mkdir(parents=True)
    (tmp_path / "campaign" / "rig.toml").write_text(RIG + PAIR, encoding="utf-8")
    return Campaign(folder, [recording_head("no images")], {}, np.random.default_rng(getattr(request, "param", 0)))


def deviation(found: Acceleration, displacement: np.ndarray) -> np.ndarray:
    """Errors of the real and imaginary parts (6, 2) over their standard uncertainties, NaN where not observed."""
    line = int(np.argmin(np.abs(found.phasors.frequency_hz - FREQUENCY_HZ)))
    error = found.phasors.value[line] + OMEGA**2 * displacement
    return np.column_stack([error.real / found.phasors.u_re[line], error.imag / found.phasors.u_im[line]])


@pytest.mark.parametrize("campaign", [0, *slow(1, 2)], indirect=True)
def test_points_and_an_accelerometer(campaign):
    campaign.add_points()
    campaign.add_sensor("base_z", "acceleration", ("base", BASE), [0.01, 0.02, 0.0])
    evaluation = campaign.evaluate()
    photogrammetry = acceleration(evaluation, "base", "photogrammetry")
    assert np.all(photogrammetry.observed)
    assert np.abs(deviation(photogrammetry, BASE)).max() < 4
    z = photogrammetry.phasors
    assert z.u_re[0, 2] < 1e-3 * abs(z.value[0, 2])  # the stated uncertainty says something
    assert np.abs(deviation(acceleration(evaluation, "base", "fused"), BASE)).max() < 4
    assert evaluation.stereo[0].motion.points.min() > 40
    assert evaluation.load is None


def test_points_and_a_trigger_only(campaign):
    campaign.add_points()
    evaluation = campaign.evaluate()
    assert not evaluation.channels
    lines = evaluation.lines
    assert lines.multiple.tolist() == [1]
    assert abs(lines.frequency_hz[0] - FREQUENCY_HZ) < 4 * lines.u_frequency_hz[0] < 1e-3
    fused = acceleration(evaluation, "base", "fused")
    assert np.abs(deviation(fused, BASE)).max() < 4
    # The phase at time zero rests on the frequency, which only 64 frames and their trigger tell.
    assert "frequency of 106.25 Hz" in {contribution.label for contribution in fused.uncertainty.grouped()}


def test_a_known_program_needs_no_columns(campaign):
    """The same points as node maps of ARAMIS, with its header, its unit and lost facets as nan."""
    campaign.add_points()
    first = campaign.evaluate()
    for path in (campaign.folder / "DIC_results").iterdir():
        rows = np.loadtxt(path)
        lost = (rows[:, 2:5] != 3).any(axis=1)
        moved = np.where(lost[:, None], np.nan, rows[:, 8:] - rows[:, 5:8])
        table = np.column_stack([8 * rows[:, 0] + rows[:, 1], rows[:, 5:8], moved])
        names = "ID; x_undef [mm]; y_undef [mm]; z_undef [mm]; u [mm]; v [mm]; w [mm]"
        np.savetxt(path, table, fmt="%.9f", delimiter="; ", header=f"stage : value : 1\n{names}")
    keys = {"stereo": "base", "files": "DIC_results/result_B*.txt", "trigger": "camera_trigger"}
    campaign.text[-1] = block("[points]", **keys)
    second = campaign.evaluate()
    for stereo in (first.stereo[0], second.stereo[0]):
        assert stereo.motion.points.min() > 40
    np.testing.assert_allclose(second.stereo[0].motion.pose, first.stereo[0].motion.pose, atol=1e-12)
    campaign.text[-1] = block("[points]", **keys, valid_status=3)
    refused(r"points\.base\.columns: .*status", campaign.evaluate, error=InputError)


def test_saved_points_are_those_of_the_files(campaign, tmp_path):
    """Displacements, but for each point's constant, and the scatter that their uncertainties state."""
    campaign.add_points()
    evaluation = campaign.evaluate()
    write_results(evaluation, tmp_path / "none")
    assert not list((tmp_path / "none").glob("points*"))
    settings = {**evaluation.settings, **Settings(save_points=True).as_dict()}
    written = write_results(replace(evaluation, settings=settings), tmp_path / "saved")
    assert written == write_results(replace(evaluation, settings=settings), tmp_path / "saved", force=True)
    names = {path.relative_to(tmp_path / "saved").as_posix() for path in written}
    assert {name for name in names if name.startswith("points")} == {
        "points-base.csv",
        "points-base.pvd",
        *(f"points-base/{k:04d}.vtp" for k in range(FRAMES)),
    }
    assert all(path.is_file() for path in written)

    table = np.genfromtxt(tmp_path / "saved" / "points-base.csv", delimiter=",", names=True)
    assert table.dtype.names == POINT_COLUMNS
    files = [np.loadtxt(campaign.folder / "DIC_results" / f"result_B{k}.txt") for k in range(FRAMES)]
    stated = np.stack([1e-3 * (rows[:, 8:] - rows[:, 5:8]) @ ROTATION.T for rows in files])
    for point in (0, 17, 47):
        rows = table[table["point"] == point]
        frames = rows["frame"].astype(int)
        off = np.column_stack([rows[f"d{axis}_m"] for axis in "xyz"]) - stated[frames, point]
        assert np.ptp(off, axis=0).max() < 1e-9
        np.testing.assert_array_equal(rows["time_s"], evaluation.stereo[0].time_s[frames])
    for axis, noise in zip("xyz", (1e-6, 1e-6, 3e-6), strict=True):
        found = np.sqrt(np.mean((table[f"rest_{axis}_m"] / table[f"u_rest_{axis}_m"]) ** 2))
        assert 0.93 < found < 1.07
        assert table[f"u_d{axis}_m"].mean() == pytest.approx(noise, rel=0.15)

    steps = ElementTree.parse(tmp_path / "saved" / "points-base.pvd").findall("Collection/DataSet")
    assert [float(step.get("timestep")) for step in steps] == evaluation.stereo[0].time_s.tolist()
    rows = table[table["frame"] == 5]
    arrays = vtk_arrays(tmp_path / "saved" / steps[5].get("file"))
    seen = arrays["seen"] == 1
    np.testing.assert_array_equal(np.flatnonzero(seen), rows["point"])
    for axis, place in enumerate("xyz"):
        np.testing.assert_array_equal(arrays["place_m"].reshape(-1, 3)[seen, axis], rows[f"{place}_m"])
        np.testing.assert_array_equal(arrays["displacement_m"].reshape(-1, 3)[seen, axis], rows[f"d{place}_m"])


def vtk_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file of PolyData, as VTK itself reads them where it is installed, else by its description."""
    root = ElementTree.parse(path).getroot()
    assert (root.get("type"), root.get("byte_order"), root.get("header_type")) == ("PolyData", "LittleEndian", "UInt64")
    kinds, found = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}, {}
    for array in root.iter("DataArray"):
        raw = base64.b64decode(array.text)
        assert int.from_bytes(raw[:8], "little") == len(raw) - 8
        found[array.get("Name")] = np.frombuffer(raw[8:], kinds[array.get("type")])
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOXML import vtkXMLPolyDataReader
    except ImportError:
        return found
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput().GetPointData()
    own = {data.GetArrayName(n): vtk_to_numpy(data.GetArray(n)).ravel() for n in range(data.GetNumberOfArrays())}
    assert reader.GetOutput().GetNumberOfVerts() == len(own["seen"])
    return own | {"place_m": vtk_to_numpy(reader.GetOutput().GetPoints().GetData()).ravel()}


def test_lasers_and_outputs_only(campaign):
    for name, point in (("a", [0.03, 0.0, 0.04]), ("b", [-0.02, 0.03, 0.04]), ("c", [-0.02, -0.03, 0.04])):
        campaign.add_sensor(name, "velocity", ("load", LOAD), point)
    campaign.add_output()
    evaluation = campaign.evaluate()
    fused = acceleration(evaluation, "load", "fused")
    assert fused.observed[0].tolist() == [False, False, True, True, True, False]
    assert np.nanmax(np.abs(deviation(fused, LOAD)[fused.observed[0]])) < 4
    assert not evaluation.stereo
    error = evaluation.sensitivity.value[0, 0, 2] - SENSITIVITY
    u = np.sqrt(np.diagonal(evaluation.sensitivity.covariance[0, 0, 2]))
    assert np.all(np.abs([error.real, error.imag]) < 4 * u + [0.0, 1e-12])
    assert u[0] < 2e-3 * abs(SENSITIVITY)


def test_tables_that_do_not_fit_are_named(campaign):
    campaign.add_points()
    last = campaign.folder / "DIC_results" / "result_B63.txt"
    last.write_text("1 2 3 3 3 0 0 0 0 0\n")
    refused(r"result_B63\.txt: line 1: .*11 .*10", campaign.evaluate, error=InputError)
    last.unlink()
    error = refused(r"points\.base\.first_edge: .*63 .*64", campaign.evaluate, error=InputError)
    assert error.code == EDGES_AMBIGUOUS.code
