"""A large deformation of a real specimen: matches of another program (OpenCorr, second order, radius 16)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photogram.images import open_sequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, match_stereo

COUNT = 300


@pytest.mark.parametrize(("image", "column", "bound_px"), [("0000_1", "r2", 0.05), ("0273_0", "t1", 0.02)])
def test_positions_are_those_of_the_peer(data_dir: Path, image: str, column: str, bound_px: float) -> None:
    folder = data_dir / "gt4_stereo"
    table = np.genfromtxt(folder / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True)
    table = table[np.linspace(0, len(table) - 1, COUNT).astype(int)]
    first, second = (open_sequence([folder / f"GT4-{name}.tif"]).read(0) for name in ("0000_0", image))
    points = np.column_stack([table["x"], table["y"]])
    tracks = match_stereo(first, second, points, TrackSettings(radius_px=16))
    assert np.mean(tracks.status == TrackStatus.OK) > 0.98
    peer = np.column_stack([table[f"{column}_x"], table[f"{column}_y"]])
    distance = np.hypot(*(tracks.position_px[0] - peer).T)
    assert np.nanmedian(distance) <= bound_px
