"""Speckle images of a moving body with known truth, made without any part of the tracker."""

from photogram.synthetic.information import motion_bound
from photogram.synthetic.noise import ImageSensor
from photogram.synthetic.render import render, render_exposure
from photogram.synthetic.scene import Face, View, view_of
from photogram.synthetic.session import session_covariance
from photogram.synthetic.texture import Texture, speckle_texture, texture_from_samples

__all__ = [
    "Face",
    "ImageSensor",
    "Texture",
    "View",
    "motion_bound",
    "render",
    "render_exposure",
    "session_covariance",
    "speckle_texture",
    "texture_from_samples",
    "view_of",
]
