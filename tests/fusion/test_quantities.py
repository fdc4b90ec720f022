"""What HDF5 files of results say of themselves: units, words, named axes, read by h5py and by xarray."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from support import undescribed_datasets

from fusion.campaign.recording_results import read_recorded
from fusion.cli import main
from fusion.report.h5 import Group
from fusion.report.recording_report import write_h5
from fusion.sensitivity.analyse import Evaluation

RATIOS = "[(V/V)/N, (V/V)/N, (V/V)/N, (V/V)/(N.m), (V/V)/(N.m), (V/V)/(N.m)]"
LOADS, MOTIONS = "[N, N, N, N.m, N.m, N.m]", "[m/s^2, m/s^2, m/s^2, rad/s^2, rad/s^2, rad/s^2]"
POSE = "[m, m, m, rad, rad, rad]"
STATED = {
    "load/value": (LOADS, "frequency_hz components"),
    "load/uncertainty/covariance": (f"{LOADS}^2", "frequency_hz row column"),
    "load/uncertainty/effect": (LOADS, "name frequency_hz row"),
    "load/uncertainty/u": ("[unit]", "name"),
    "accelerations/load-fused/phasors/value": (MOTIONS, "frequency_hz channels"),
    "accelerations/load-fused/observed": ("1", "frequency_hz channels"),
    "accelerations/load-fused/posterior": ("1", "unknown unknown_of"),
    "accelerations/load-fused/products": ("1", "unknown"),
    "outputs/phasors/covariance": ("(V/V)^2", "frequency_hz row column"),
    "sensitivity/value": (RATIOS, "frequency_hz channels components"),
    "sensitivity/uncertainty/covariance": ("((V/V)/N)^2", "frequency_hz row column"),
    "stereo/top/motion/pose": (POSE, "time_s channels"),
    "stereo/top/motion/covariance": (f"{POSE}^2", "time_s channels component"),
    "stereo/top/deflection/value": ("m", "frequency_hz point axis"),
    "channels/bridge-Fz/spectrum": ("V/V", "spectrum_hz"),
    "channels/bridge-Fz/stationarity/u_amplitude_per_s": ("(V/V)/s", "frequency_hz channels"),
    "clocks/bridge/trigger/edge_s": ("s", "number"),
    "points/laser/plane": ("[m/s^2, rad/s^2, rad/s^2]", "frequency_hz plane_of"),
    "sensor/capacity": (LOADS, "components"),
}
GROUPS = {
    "load": {"frequency_hz": 3, "components": 6, "notices": 0},
    "outputs/phasors": {"frequency_hz": 3, "channels": 6, "row": 12, "column": 12},
    "sensitivity": {"frequency_hz": 3, "channels": 6, "components": 6, "element": 6, "of": 2},
    "accelerations/load-fused/phasors": {"frequency_hz": 3, "channels": 6, "row": 12, "column": 12},
    "stereo/top/deflection": {"frequency_hz": 3, "point": 115, "axis": 3},
}


@pytest.fixture(scope="module")
def result(demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("quantities") / "result.h5"
    write_h5(path, demo_evaluation, [])
    return path


def test_every_number_of_a_result_has_unit_words_and_named_axes(result):
    with h5py.File(result) as file:
        assert undescribed_datasets(file) == []
        for path, (units, axes) in STATED.items():
            data = file[path]
            assert data.attrs["units"] == units, path
            assert [dim[0].name.rpartition("/")[2] for dim in data.dims] == axes.split(), path
        assert all(data.attrs["units"].isascii() for data in map(file.get, STATED))


def test_labels_of_axes_are_those_of_the_values(result, demo_evaluation):
    with h5py.File(result) as file:
        labels = file["sensitivity/uncertainty/row"].asstr()[()].tolist()
        assert labels[:3] == ["Re Fx/Fz", "Re Fy/Fz", "Re Fz/Fz"]
        assert labels[6:8] == ["Im Fx/Fz", "Im Fy/Fz"]
        assert file["load/components"].asstr()[()].tolist() == ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
        assert file["stereo/top/channels"].asstr()[()].tolist() == ["x", "y", "z", "rx", "ry", "rz"]
        frequency = demo_evaluation.load.frequency_hz
        assert np.array_equal(file["accelerations/load-fused/frequency_hz"], frequency)


def test_a_campaign_reads_the_recording_estimate_of_its_unknowns(result, demo_evaluation):
    fused = demo_evaluation.accelerations[0]
    known = read_recorded(result.parent).knowledge()
    assert np.array_equal(known.covariance, fused.posterior)
    assert [about[:4] for about in known.descriptions] == [(u.name, u.label, u.u, u.unit) for u in fused.unknowns]
    shared = {about[0] for about, own in zip(known.descriptions, known.shared, strict=True) if own}
    assert "stereo top: pose rotation x" in shared
    assert not any(name.startswith("frequency of") for name in shared)


def test_xarray_opens_groups_with_named_dimensions_and_the_numbers(result, demo_evaluation):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    for group, sizes in GROUPS.items():
        with xarray.open_dataset(result, group=group, engine="h5netcdf") as data:
            assert dict(data.sizes) == sizes, group
    with xarray.open_dataset(result, group="load", engine="h5netcdf") as data:
        found = data["value"].sel(components="Fz").to_numpy()
        assert np.array_equal(found, demo_evaluation.load.value[:, 2])
        assert np.array_equal(data["frequency_hz"], demo_evaluation.load.frequency_hz)
        assert data["value"].attrs == {"units": LOADS, "long_name": "peak phasors of the load"}
    with xarray.open_dataset(result, group="sensitivity", engine="h5netcdf") as data:
        found = data["value"].sel(channels="My", components="Fz").to_numpy()
        assert np.array_equal(found, demo_evaluation.sensitivity.value[:, 4, 2], equal_nan=True)


def test_a_taken_name_is_refused_and_a_user_text_becomes_a_free_one():
    tree = Group()
    tree.create_group("z/ä").attrs["b"] = "below"
    assert tree["z/ä"].attrs["b"] == "below"
    assert tree.free_name("z") == "z (2)"
    assert "/" not in tree.free_name("a/b")
    with pytest.raises(ValueError, match=r"^/"):
        tree.create_group("z")


@pytest.mark.slow
def test_draws_have_unit_words_and_named_axes(demo_recording, tmp_path):
    command = ["run", str(demo_recording), "--monte-carlo", "1000", "-q", "-o", str(tmp_path / "out")]
    assert main(command) == 0
    (path,) = (tmp_path / "out").rglob("result.h5")
    with h5py.File(path) as file:
        assert undescribed_datasets(file) == []
        assert file["monte_carlo/results/load/magnitude/u"].attrs["units"] == LOADS
        assert file["monte_carlo/results/load/phase/u"].attrs["units"] == "rad"
