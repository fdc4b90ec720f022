"""A vibrating beam filmed far below its frequency: every hundredth sample of another program's 15 kHz series."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photogram.images import open_sequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, track_sequence

FIRST_X_PX, SPACING_PX, EDGES_Y_PX = 20.0, 40.0, 20.0
INNER_POINTS = range(1, 7)


def test_frames_follow_every_hundredth_sample(data_dir: Path) -> None:
    """The series has column 0 = vertical, in metres; its points lie 40 px apart (found by correlation, not published).

    Seven subsets around each of six points are averaged, which spans the beam like the points of the series do.
    """
    folder = data_dir / "undersampled_video"
    sequence = open_sequence([folder / "data_showcase.cih"])
    series = np.load(folder / "displacements_lk.npy")[INNER_POINTS.start : INNER_POINTS.stop, ::100, 0]
    middle = FIRST_X_PX + SPACING_PX * np.array(INNER_POINTS, dtype=float)
    x = (middle[:, None] + np.arange(-15.0, 16.0, 5.0)).ravel()
    tracks = track_sequence(sequence, np.column_stack([x, np.full_like(x, EDGES_Y_PX)]), TrackSettings(radius_px=10))
    assert tracks.position_px.shape == (75, len(x), 2)
    assert np.all(tracks.status == TrackStatus.OK)
    vertical = tracks.position_px[: series.shape[1], :, 1].mean(axis=1)
    assert np.corrcoef(vertical, series.mean(axis=0))[0, 1] >= 0.9999
