"""The complex matrix of outputs over six load components at one frequency, and what it says of the sensor."""

from fusion.matrix.cross_talk import CrossTalk, cross_talk, main_components
from fusion.matrix.fit import Agreement, MatrixFit, fit_matrix
from fusion.matrix.rank import LEAST_SINGULAR, Excitation, MissingExcitationError

__all__ = [
    "LEAST_SINGULAR",
    "Agreement",
    "CrossTalk",
    "Excitation",
    "MatrixFit",
    "MissingExcitationError",
    "cross_talk",
    "fit_matrix",
    "main_components",
]
