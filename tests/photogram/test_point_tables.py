"""Points of other programs without named columns: samples with truth, layouts written from their documents, damage."""

from __future__ import annotations

import numpy as np
import pytest
from contracts import refused
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from photogram.geometry import fit_rigid
from photogram.point_tables import read_matrix, read_point_tables

MOTION = Rotation.from_euler("xyz", [0.3, -0.2, 0.5], degrees=True).as_matrix(), np.array([0.4, -0.1, 0.2])
RNG = np.random.default_rng(3)
PIXELS = np.stack(np.meshgrid(np.arange(100, 400, 50), np.arange(100, 300, 50)), -1).reshape(-1, 2)
BEFORE = np.column_stack([0.1 * PIXELS, RNG.uniform(400, 410, len(PIXELS))])
AFTER = BEFORE @ MOTION[0].T + MOTION[1]


def _table(path, header, columns, separator=", ", comma=False):
    rows = [separator.join(f"{value:.10g}".replace(".", "," if comma else ".") for value in row) for row in columns.T]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def _vic3d(path, after, comma=False):
    names = ["X [mm]", "Y [mm]", "Z [mm]", "U [mm]", "V [mm]", "W [mm]", "x [pixel]", "y [pixel]"]
    names += ["Sigma_X [mm]", "Sigma_Y [mm]", "Sigma_Z [mm]", "sigma [pixel]"]
    u = np.tile([[0.001], [0.002], [0.004]], len(after))
    sigma = np.full(len(after), 0.01)
    sigma[4] = -1.0  # lost
    columns = np.vstack([BEFORE.T, (after - BEFORE).T, PIXELS.T, u, sigma])
    separator = "; " if comma else ", "
    return _table(path, separator.join(f'"{name}"' for name in names), columns, separator, comma)


def _assert_moved(table, lost=()):
    """The second frame is the first one, moved rigidly."""
    kept = np.setdiff1d(np.arange(len(BEFORE)), lost)
    found = fit_rigid(table.position_m[0][kept], table.position_m[1][kept])
    np.testing.assert_allclose(found.rotation, MOTION[0], atol=1e-8)
    np.testing.assert_allclose(found.translation_m, 1e-3 * MOTION[1], atol=1e-8)
    assert np.isnan(table.position_m[:, list(lost)]).all()


@pytest.mark.parametrize("comma", [False, True])
def test_vic3d_table_with_uncertainties(tmp_path, comma):
    files = [_vic3d(tmp_path / f"a{k}.csv", after, comma) for k, after in enumerate((BEFORE, AFTER))]
    table = read_point_tables(files)
    assert table.program == "VIC-3D"
    order = np.lexsort(PIXELS.T[::-1])  # points are sorted by their pixel
    lost = int(np.flatnonzero(order == 4)[0])
    np.testing.assert_allclose(np.delete(table.reference_m - 1e-3 * BEFORE[order], lost, axis=0), 0, atol=1e-10)
    np.testing.assert_allclose(np.delete(table.u_m, lost, axis=1)[1, 0], [1e-6, 2e-6, 4e-6])
    _assert_moved(table, [lost])
    np.testing.assert_allclose(read_point_tables(files, scale=1.0).u_m[0, 0], [1e-3, 2e-3, 4e-3])


def test_vic3d_mat_files_need_the_unit(tmp_path):
    for k, after in enumerate((BEFORE, AFTER)):
        shaped = {name: part.reshape(4, 6) for name, part in zip("XYZ", BEFORE.T, strict=True)}
        shaped |= {name: part.reshape(4, 6) for name, part in zip("UVW", (after - BEFORE).T, strict=True)}
        savemat(tmp_path / f"a{k}.mat", {**shaped, "sigma": np.full((4, 6), 0.01), "note": "x"})
    files = [tmp_path / "a0.mat", tmp_path / "a1.mat"]
    refused(r"a0\.mat: X: .*scale", read_point_tables, files)
    _assert_moved(read_point_tables(files, scale=1e-3))
    files[0].write_bytes(files[1].read_bytes()[:300])
    refused(r"a0\.mat: .*variable", read_point_tables, files, scale=1e-3)


def test_dice_and_pyvale_tables(tmp_path):
    dice = [f"MODEL_{kind}_{axis}" for kind in ("COORDINATES", "DISPLACEMENT") for axis in "XYZ"]
    header = "***\n*** Step size: x 35, y 35\n***\n" + ",".join(
        ["COORDINATE_X", "COORDINATE_Y", *dice, "SIGMA", "UNCERTAINTY"]
    )
    pyvale = ["subset_x", "subset_y", *(f"stereo_disp_{c}_mm" for c in "uvw"), *(f"stereo_{c}_mm" for c in "xyz")]
    dice_files, pyvale_files = [], []
    for k, after in enumerate((BEFORE, AFTER)):
        ones, moves = np.ones(len(after)), (after - BEFORE).T
        columns = np.vstack([PIXELS.T, BEFORE.T, moves, 0.01 * ones, 0.02 * ones])
        dice_files.append(_table(tmp_path / f"DICe_{k}.txt", header, columns, ","))
        names = ",".join(f'"{name}"' for name in [*pyvale, "stereo_converged"])
        columns = np.vstack([PIXELS.T, moves, after.T, ones])
        columns[2:-1, 7] = 0.0  # what pyvale leaves of a point that it lost
        pyvale_files.append(_table(tmp_path / f"pyvale_{k}.csv", names, columns, ","))
    first, second = read_point_tables(dice_files), read_point_tables(pyvale_files)
    assert (first.program, second.program) == ("DICe", "pyvale")
    order = np.lexsort(PIXELS.T[::-1])
    lost = int(np.flatnonzero(order == 7)[0])
    _assert_moved(first)
    _assert_moved(second, [lost])
    kept = np.delete(np.arange(len(BEFORE)), lost)
    np.testing.assert_allclose(first.reference_m[kept], second.reference_m[kept], atol=1e-10)
    refused(r"pyvale_1\.csv: .*DICe", read_point_tables, [dice_files[0], pyvale_files[1]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header"),
        ('"X [mm]","Y [mm]"\n1,2\n', "VIC-3D, ARAMIS, DICe, pyvale, .* X, Y"),
        ("ID;x_undef [mm]\n1;2;3\n", "line 2: .* 2 columns, .* 3"),
        ("ID;x_undef [mm]\n1;2\n3;x\n", "line 3, column 2: .*'x'"),
        ("ID;x_undef [px];y_undef;z_undef;u;v;w\n1;2;3;4;5;6;7\n", "x_undef: .* px"),
        ("ID;x_undef [mm];y_undef;z_undef;u;v;w\n1;2;3;4;5;6;7\n", "y_undef: .*unit"),
    ],
)
def test_an_unreadable_table_is_refused_in_one_sentence(tmp_path, text, message):
    path = tmp_path / "t.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        read_point_tables([path])
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_matchid_matrices_of_two_frames(tmp_path):
    files = []
    for k, after in enumerate((BEFORE, AFTER)):
        for quantity, part in zip("XYZUVW", (*BEFORE.T, *(after - BEFORE).T), strict=True):
            rows = [[f"{value:.9f}".replace(".", ",") for value in row] for row in part.reshape(4, 6)]
            rows[1][2] = "Non un numero reale"
            files.append(tmp_path / f"frame{k}_0.tif_{quantity}[mm].csv")
            files[-1].write_text("".join(";".join(row) + ";\n" for row in rows))
    table = read_point_tables(files)
    assert (table.program, len(table.frames)) == ("MatchID", 2)
    _assert_moved(table, [8])
    refused("frame1_0.tif: .* W", read_point_tables, files[:-1])
    files[0].write_text("1;2;\n3;\n")
    refused("line 2: ", read_point_tables, files)


@pytest.fixture
def formats(data_dir):
    folder = data_dir / "formats"
    if not folder.is_dir():
        pytest.skip("no sample files of laboratory formats")
    return folder


@pytest.mark.parametrize(
    ("name", "shape", "numbers", "first", "mean", "ends"),
    [
        ("patD107_0.tif_U[mm].csv", (68, 78), 5304, -0.002399, 0.0010000274, (-0.023127, 0.032366)),
        ("patD110_0.tif_U[mm].csv", (68, 78), 5304, 0.004249, 0.0043590875, (-0.02941, 0.033781)),
        ("mesh_plane_1.csv_0.tiff_V[mm].csv", (61, 52), 289, np.nan, 0.0, (0.0, 0.0)),
        ("mesh_plane_4.csv_0.tiff_V[mm].csv", (58, 47), 63, np.nan, 6.4199962063, (0.004795, 22.038585)),
    ],
)
def test_matrices_written_by_matchid(formats, name, shape, numbers, first, mean, ends):
    matrix = read_matrix(formats / "matchid" / name)
    assert (matrix.shape, np.isfinite(matrix).sum()) == (shape, numbers)
    np.testing.assert_array_equal(matrix[0, 0], first)
    assert np.nanmean(matrix) == pytest.approx(mean, abs=1e-9)
    assert (np.nanmin(matrix), np.nanmax(matrix)) == ends
    refused("X Y Z", read_point_tables, [formats / "matchid" / name])


@pytest.mark.parametrize(
    ("stage", "kept", "fitted", "truth"),
    [
        (3, 2305, (0.00139107, -0.00045719), (0.00138889, -0.00045833)),
        (6, 2307, (0.00047126, 0.00232538), (0.00047222, 0.00231944)),
    ],
)
def test_aramis_node_maps_have_the_imposed_strain(formats, stage, kept, fitted, truth):
    names = [f"TestProject_SP_SynLoads_dic_results_0_{k}_every8th.txt" for k in (0, stage)]
    table = read_point_tables([formats / "aramis" / name for name in names])
    assert table.program == "ARAMIS"
    before, after = table.reference_m, table.position_m[1]
    valid = np.isfinite(after).all(axis=1)
    assert valid.sum() == kept
    design = np.column_stack([np.ones(kept), before[valid, :2]])
    slopes = np.linalg.lstsq(design, (after - before)[valid, :2], rcond=None)[0]
    np.testing.assert_allclose((slopes[1, 0], slopes[2, 1]), fitted, atol=6e-8)
    np.testing.assert_allclose((slopes[1, 0], slopes[2, 1]), truth, atol=6e-6)


def test_results_of_dice_in_the_plane_are_refused_by_what_they_lack(data_dir):
    refused("COORDINATE_X, COORDINATE_Y", read_point_tables, [data_dir / "static_stereo" / "DICe_solution_auto_0.txt"])
