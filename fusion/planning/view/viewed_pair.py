"""Images of a stereo pair for display: frames that belong together, and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fusion.phasors.stereo_motion import read_rig
from fusion.phasors.timing import edges_of_runs
from fusion.planning.view.readable import StatedImages, notice_of
from fusion.planning.view.shown_images import CameraImages, ShownImage, numbers_of_frames, paired_frames
from photogram.camera import Rig


@dataclass(frozen=True)
class ViewedPair:
    """The images of a stereo pair or a single camera in one set-up."""

    stated: StatedImages
    recording: Path

    @cached_property
    def cameras(self) -> Mapping[str, CameraImages]:
        """Images of each camera that has any, by its key."""
        return {side: CameraImages(files, self.stated.bit_depth) for side, files in self.stated.files.items() if files}

    @cached_property
    def frames(self) -> list[list[int | None]]:
        """Place of each shown frame among the files of each camera, or None."""
        return paired_frames(self._edges or numbers_of_frames(list(self.cameras.values())))

    @property
    def _edges(self) -> list[list[int]] | None:
        """Edges of the images of each camera, if they are stated."""
        entry = self.stated.entry
        if entry is None or not isinstance(entry.first_edge, dict):
            return None
        counted = [(side, camera.numbers, len(camera)) for side, camera in self.cameras.items()]
        return [edges_of_runs(entry, side, numbers, count).tolist() for side, numbers, count in counted]

    def evaluated_frames(self, count: int) -> list[int]:
        """Return the shown frames of `count` frames of results, which all cameras have."""
        edges = self._edges
        every = [None not in frame for frame in self.frames]
        keys = sorted(set().union(*edges)) if edges else range(len(every))
        return [number for number, (key, both) in enumerate(zip(keys, every, strict=True)) if both and key >= 0][:count]

    @cached_property
    def rig(self) -> Rig:
        """The calibrated cameras."""
        if self.stated.pair is None:
            raise ValueError("The pair's block of rig.toml has errors.")
        sequences = [one.sequence for one in self.cameras.values()]
        return read_rig(self.stated.pair, [one for one in sequences if one is not None])

    def notice(self, error: Exception, side: str = "") -> dict[str, str]:
        """Return an error of its images, or of those of one camera."""
        return notice_of(error, self.recording, f"images.{self.stated.name}{'.' * bool(side)}{side}")

    def read(self, side: str, frame: int) -> ShownImage:
        """Return the image of a camera in a shown frame."""
        if not 0 <= frame < len(self.frames):
            raise ValueError(f"frame: expected 0 to {len(self.frames) - 1}, found {frame}")
        place = self.frames[frame][list(self.cameras).index(side)]
        if place is None:
            raise ValueError("The camera has no image of this frame.")
        return self.cameras[side].read(place)

    @property
    def description(self) -> Mapping[str, Any]:
        """Names, sizes and errors of its images."""
        cameras = []
        for number, (side, camera) in enumerate(self.cameras.items()):
            sequence = camera.sequence
            names = [Path(name).name for name in camera.names]
            places = [frame[number] for frame in self.frames]
            cameras.append(
                {
                    "side": side,
                    "size": [640, 480] if sequence is None else list(sequence.size_px),
                    "full": 255 if sequence is None else sequence.full_scale,
                    "files": ["" if place is None else names[place] for place in places],
                    "refused": [i for i, place in enumerate(places) if place is None or place in camera.refused],
                }
            )
        return {"name": self.stated.name, "frames": len(self.frames), "cameras": cameras}
