"""A real scene at rest, three stereo pairs: whatever moves is noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photogram.images import open_sequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, track_stereo


def test_nothing_moves_by_more_than_its_noise(data_dir: Path) -> None:
    folder = data_dir / "static_stereo"
    left, right = (open_sequence([folder / f"img_000{k}_{side}.tif" for k in range(3)]) for side in (0, 1))
    stereo = track_stereo(left, right, None, TrackSettings(radius_px=13))
    for tracks in (stereo.left, stereo.right):
        assert tracks.position_px.shape[1] > 500
        assert np.mean(tracks.status == TrackStatus.OK) > 0.98
        moved = tracks.position_px[1:] - tracks.position_px[0]
        scatter = np.nanstd(moved, axis=1)
        stated = np.sqrt(2.0 * np.nanmean(tracks.covariance_px2[1:][..., [0, 1], [0, 1]], axis=1))
        assert scatter.max() <= 0.005
        assert np.abs(np.nanmean(moved, axis=1)).max() <= 0.020
        np.testing.assert_allclose(scatter / stated, 1.0, atol=0.25)
