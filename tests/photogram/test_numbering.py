"""Which frames a series lacks, by names as cameras' programs write them and by time stamps."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.images.sequence import numbers_of_names, numbers_of_times

EIGHT = list(range(8))
LACK = [0, 1, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("names", "place", "missing"),
    [
        ([f"{k:04d}.png" for k in EIGHT], EIGHT, ""),
        ([f"{k:04d}.png" for k in LACK], LACK, "0002"),
        ([f"img{k + 7}.tif" for k in LACK], LACK, "9"),  # without zeros, and another first number
        ([f"cam1_run12_{10 * k:05d}.tif" for k in EIGHT], EIGHT, ""),
        ([f"cam1_run12_{10 * k:05d}.tif" for k in LACK], LACK, "00020"),
        ([f"{k}.tif" for k in (0, 1, 2, 6, 7, 9)], [0, 1, 2, 6, 7, 9], "3 to 5, 8"),
        ([f"{k}.tif" for k in (0, 2, 3, 5, 6, 8, 9, 11, 12, 13, 14, 15, 16)], None, "1, 4, 7 and 1 more"),
        ([f"{k:03d}_{1000 * k + 13 * (k % 3)}.tif" for k in LACK], LACK, "002"),  # a counter and a time
        ([f"{n:03d}_{k + 120}.tif" for n, k in enumerate(LACK)], LACK, "122"),  # number of the file, of the frame
        ([f"t{1693829123000 + 26 * k + k % 3}.tif" for k in EIGHT], EIGHT, ""),
        ([f"t{1693829123000 + 26 * k + k % 3}.tif" for k in LACK], LACK, "1 between 1693829123027 and 1693829123078"),
        ([f"{t}.tif" for t in (120059701, 120059799, 120059902, 120100001, 120100103)], EIGHT[:5], ""),  # hhmmss
        ([f"{t}.tif" for t in (125959701, 125959799, 125959902, 130000001, 130000103)], EIGHT[:5], ""),
    ],
)
def test_names_count_frames(names, place, missing):
    counted = numbers_of_names(names)
    assert counted is not None
    assert counted.missing == missing
    assert place is None or counted.frame_index.tolist() == place


@pytest.mark.parametrize(
    "names",
    [
        ["left.tif", "right.tif", "rest.tif"],
        ["a1.tif", "a2.tif"],
        ["b3.tif", "b2.tif", "b1.tif"],  # as given in the manifest
        ["3.tif", "17.tif", "18.tif", "40.tif", "73.tif"],  # chosen by hand
        [f"{'9' * 30}{k}.tif" for k in range(4)],
        ["x1.tif", "y2.tif", "x3.tif"],
    ],
)
def test_names_without_a_count_have_no_numbers(names):
    assert numbers_of_names(names) is None


@pytest.mark.parametrize("rate_hz", [25.0, 38.3, 240.0, 480.0])
def test_time_stamps_of_a_film_show_what_it_lacks(rate_hz):
    """Rounded to a millisecond, as Matroska stores them."""
    whole, lacking = (np.round(np.array(which) / rate_hz, 3) for which in (EIGHT * 1, LACK))
    assert numbers_of_times(whole, 1e-3).missing == ""
    assert numbers_of_times(lacking, 1e-3).frame_index.tolist() == LACK
    assert "1 between" in numbers_of_times(lacking, 1e-3).missing
    assert numbers_of_times(np.array([0.0, 0.03, 0.08, 0.1, 0.16, 0.2]), 1e-3) is None  # as a telephone films
    assert numbers_of_times(np.arange(5) * 1e-3, 1e-3) is None  # too fast for its stamps
