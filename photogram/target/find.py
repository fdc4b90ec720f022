"""One door to all targets."""

from __future__ import annotations

from photogram.images import GreyImage
from photogram.target.view import Target, TargetView


def find_target(image: GreyImage, target: Target, name: str, full_scale: int) -> TargetView:
    """Return the points of `target` in a picture (H, W) called `name`; `full_scale` is its largest grey value.

    Raises `TargetNotFound` with what is wrong with the picture.
    """
    if target.kind == "chessboard":
        from photogram.target.chessboard import find_chessboard

        return find_chessboard(image, target, name, full_scale)
    if target.kind == "charuco":
        from photogram.target.charuco import find_charuco

        return find_charuco(image, target, name, full_scale)
    from photogram.target.dots import find_dots

    return find_dots(image, target, name, full_scale)
