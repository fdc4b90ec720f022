"""Masses, stiffness and damping of a structure from measured transfer functions of several loads, in one fit."""

from shaker.models.identification.fit import identify
from shaker.models.identification.mechanics import Mechanics, Parameter, Response, Structure, poles, respond
from shaker.models.identification.rational import measured_poles
from shaker.models.identification.result import FreeFactor, Identification, ModeEstimate, NamedUnknown

__all__ = [
    "FreeFactor",
    "Identification",
    "Mechanics",
    "ModeEstimate",
    "NamedUnknown",
    "Parameter",
    "Response",
    "Structure",
    "identify",
    "measured_poles",
    "poles",
    "respond",
]
