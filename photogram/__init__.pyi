"""The public names of photogram and where each lives, for type checkers and for `photogram/__init__.py`."""

from .alignment.alignment_evidence import KnownPoints as KnownPoints
from .alignment.pose_estimation import align as align
from .calibration.calibration_file import read_calibration as read_calibration
from .calibration.calibration_file import write_calibration as write_calibration
from .calibration.exchange.exchange_files import export_calibration as export_calibration
from .calibration.exchange.exchange_files import import_calibration as import_calibration
from .calibration.session import calibrate_pair as calibrate_pair
from .camera import Camera as Camera
from .camera import StereoRig as StereoRig
from .camera import triangulate as triangulate
from .geometry import RigidTransform as RigidTransform
from .images.image_files import open_sequence as open_sequence
from .images.image_files import read_image as read_image
from .images.sequence import ImageSequence as ImageSequence
from .measure.body import measure_body as measure_body
from .measure.epipolar import check_epipolar as check_epipolar
from .motion import fit_motion as fit_motion
from .point_tables import read_point_tables as read_point_tables
from .subsets.icgn import TrackSettings as TrackSettings
from .subsets.track import track_stereo as track_stereo
from .synthetic.board import render_board as render_board
from .synthetic.patterns import Board as Board
from .synthetic.scene import Face as Face
from .synthetic.scene import ImageSensor as ImageSensor
from .synthetic.scene import render as render
from .synthetic.scene import speckle_texture as speckle_texture
from .synthetic.scene import view_of as view_of
from .targets.find_target import find_target as find_target
from .targets.target_view import Target as Target

__version__: str
