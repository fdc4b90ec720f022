"""Coordinates in which models of several releases can be averaged: what a record tells well is linear in them."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.modal import ModalModel


def to_coordinates(model: ModalModel, scale: float) -> FloatArray:
    """Return [f_n (M), ζ (M), 1/real_hz (Q), n_0 … n_{P-1}] (2P,), P = 2M + Q, of a model.

    H(s) = Σ n_k (s/ω0)^k/Π(1 - s/p), ω0 = `scale` in rad/s: n_0 is the static gain, and a response that starts
    smoothly has its highest n_k zero, in every mean too. A real pole enters by its lag: one far above the modes, which
    hardly shows, has a lag about zero, while its frequency may be anything.
    """
    poles, residues = _all(model)
    found = np.zeros(len(poles), dtype=np.complex128)
    for place in range(len(poles)):
        others = np.delete(poles, place)
        found += residues[place] * np.poly(others / scale)[::-1] / scale
    numerator = found / np.prod(-poles / scale)
    return np.concatenate([model.frequency_hz, model.damping_ratio, 1.0 / model.real_hz, numerator.real])


def from_coordinates(coordinates: FloatArray, modes: int, reals: int, scale: float) -> FloatArray:
    """Return the vector (2P,) of a `ModalModel` of coordinates (2P,), the inverse of `to_coordinates`."""
    order = 2 * modes + reals
    frequency, damping, lag, numerator = np.split(coordinates, [modes, 2 * modes, order])
    frame = ModalModel(frequency, damping, np.zeros(modes, dtype=np.complex128), 1.0 / lag, np.zeros(reals))
    poles, _ = _all(frame)
    upper, real = poles[:modes], poles[2 * modes :]
    residues = [_residue(place, poles / scale, numerator) for place in (*range(modes), *range(2 * modes, order))]
    found = np.array(residues, dtype=np.complex128) * scale
    of_modes, of_reals = found[: len(upper)], found[len(upper) :].real
    return np.concatenate([frequency, damping, of_modes.real, of_modes.imag, -real.real / (2 * np.pi), of_reals])


def sizes(coordinates: FloatArray, reals: int) -> FloatArray:
    """Return how large coordinates (2P,) are: themselves, those of the numerator the largest of these."""
    half = len(coordinates) // 2
    found = np.abs(coordinates)
    found[half:] = found[half:].max()
    lags = slice(half - reals, half)
    found[lags] = found[lags].max(initial=0.0)
    return np.asarray(found)


def scale_of(model: ModalModel) -> float:
    """Return the geometric mean of a model's poles in rad/s."""
    return float(np.exp(np.mean(np.log(np.abs(_all(model)[0])))))


def _all(model: ModalModel) -> tuple[ComplexArray, ComplexArray]:
    """All poles (P,) in rad/s and their residues: upper ones, lower ones, real ones."""
    upper, real = np.split(model.poles, [len(model.frequency_hz)])
    residues = (model.residue, model.residue.conj(), model.real_residue + 0j)
    return np.concatenate([upper, upper.conj(), real]), np.concatenate(residues)


def _residue(place: int, poles: ComplexArray, numerator: FloatArray) -> complex:
    """Residue at one of the poles (P,), over the scale, of Σ n_k x^k/Π(1 - x/p)."""
    pole = poles[place]
    top = np.polyval(numerator[::-1], pole)
    others = np.delete(poles, place)
    return complex(-pole * top / np.prod(1.0 - pole / others))
