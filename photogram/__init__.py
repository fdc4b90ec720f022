"""Images to rigid motion: subset tracking, triangulation, rigid fit. Knows nothing of shakers, clocks or sensors.

Everything named here is public; a name is imported when it is first used, so that `import photogram` costs nothing.
Examples assume `import numpy as np` and `from photogram import *`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from photogram.alignment.evidence import KnownPoints
    from photogram.alignment.solve import align
    from photogram.calibration.file import read_calibration, write_calibration
    from photogram.calibration.foreign_formats import import_calibration
    from photogram.calibration.session import calibrate_pair
    from photogram.camera import Camera, StereoRig, triangulate
    from photogram.epipolar import check_epipolar
    from photogram.geometry import RigidTransform
    from photogram.images import ImageSequence, open_sequence, read_picture
    from photogram.measure import measure_body
    from photogram.motion import fit_motion
    from photogram.point_tables import read_point_tables
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.track import track_stereo
    from photogram.synthetic.board import Board, render_board
    from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of
    from photogram.targets.view import Target, find_target

_MODULES = {
    "Board": "photogram.synthetic.board",
    "Camera": "photogram.camera",
    "Face": "photogram.synthetic.scene",
    "ImageSensor": "photogram.synthetic.scene",
    "ImageSequence": "photogram.images",
    "KnownPoints": "photogram.alignment.evidence",
    "RigidTransform": "photogram.geometry",
    "StereoRig": "photogram.camera",
    "Target": "photogram.targets.view",
    "TrackSettings": "photogram.subsets.icgn",
    "align": "photogram.alignment.solve",
    "calibrate_pair": "photogram.calibration.session",
    "check_epipolar": "photogram.epipolar",
    "find_target": "photogram.targets.view",
    "fit_motion": "photogram.motion",
    "import_calibration": "photogram.calibration.foreign_formats",
    "measure_body": "photogram.measure",
    "open_sequence": "photogram.images",
    "read_calibration": "photogram.calibration.file",
    "read_picture": "photogram.images",
    "read_point_tables": "photogram.point_tables",
    "render": "photogram.synthetic.scene",
    "render_board": "photogram.synthetic.board",
    "speckle_texture": "photogram.synthetic.scene",
    "track_stereo": "photogram.subsets.track",
    "triangulate": "photogram.camera",
    "view_of": "photogram.synthetic.scene",
    "write_calibration": "photogram.calibration.file",
}
"""Where each public name lives."""

__all__ = [
    "Board",
    "Camera",
    "Face",
    "ImageSensor",
    "ImageSequence",
    "KnownPoints",
    "RigidTransform",
    "StereoRig",
    "Target",
    "TrackSettings",
    "__version__",
    "align",
    "calibrate_pair",
    "check_epipolar",
    "find_target",
    "fit_motion",
    "import_calibration",
    "measure_body",
    "open_sequence",
    "read_calibration",
    "read_picture",
    "read_point_tables",
    "render",
    "render_board",
    "speckle_texture",
    "track_stereo",
    "triangulate",
    "view_of",
    "write_calibration",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("shakercal")
    elif name in _MODULES:
        from importlib import import_module

        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
