"""Calibration targets of any kind in an image."""

from __future__ import annotations

from photogram.images.sequence import GreyImage
from photogram.targets.aprilgrid import find_aprilgrid
from photogram.targets.charuco import find_charuco
from photogram.targets.chessboard import find_chessboard
from photogram.targets.dots import find_dots
from photogram.targets.target_view import Target, TargetView


def find_target(image: GreyImage, target: Target, name: str, full_scale: int, partial: bool = False) -> TargetView:
    """Find the points of a calibration target in an image.

    Parameters
    ----------
    image
        (H, W).
    target
        The target.
    name
        Of the image.
    full_scale
        Its largest possible grey value.
    partial
        Accept a part of a chessboard, whose corners have no certain number (`TargetView.is_partial`); default False.

    Returns
    -------
    TargetView
        Sub-pixel positions in px with covariance.

    Raises
    ------
    TargetNotFound
        With the fault of the image.

    Examples
    --------
    >>> board = Board(Target("chessboard", 9e-3, (8, 5)))
    >>> camera = Camera.from_parameters(np.array([800.0, 800, 160, 120, 0, 0, 0, 0, 0]), np.array([320, 240]))
    >>> pose = RigidTransform(np.eye(3), np.array([-0.035, -0.02, 0.3]))
    >>> image = ImageSensor(bit_depth=8).digitise(render_board(camera, pose, board), None)
    >>> find_target(image, board.target, "image 1", 255).position_px[0].round(2)
    array([66.67, 66.67])
    """
    if target.kind == "chessboard":
        return find_chessboard(image, target, name, full_scale, partial)
    if target.kind == "charuco":
        return find_charuco(image, target, name, full_scale)
    if target.kind == "aprilgrid":
        return find_aprilgrid(image, target, name, full_scale)
    return find_dots(image, target, name, full_scale)
