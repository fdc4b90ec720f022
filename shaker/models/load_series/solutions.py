"""The second set of parameters that one load mass cannot tell from the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import FloatArray
from shaker.models.load_series.model import LoadModel


def other_numbers(numbers: FloatArray, moving_mass: float, load_mass: float) -> FloatArray:
    """Return the other k, c, k_L, c_L (4,) with the same poles at one load mass.

    With K = k + c s and K_L = k_L + c_L s the polynomial of `LoadModel` is m_E m_L s⁴ + [m_L K + (m_E + m_L) K_L] s² +
    K K_L. It stays the same where K' = K_L (m_E + m_L)/m_L and K_L' = K m_L/(m_E + m_L), for any damping. The output's
    modal shares stay as well, but for the zero at -k_L/c_L, which moves to -k/c: of light damping both are far away.
    """
    ratio = (moving_mass + load_mass) / load_mass
    k, c, kl, cl = (float(number) for number in numbers)
    return np.array([kl * ratio, cl * ratio, k / ratio, c / ratio])


def other_solution(model: LoadModel, load_mass: float) -> LoadModel:
    """Return the model with the same poles at one load mass; covariances follow by first order."""
    if model.is_rigid or load_mass <= 0:
        raise ValueError("model: expected one with an elastic coupling and a load mass, found a rigid one")

    def swapped(numbers: FloatArray) -> FloatArray:
        return np.append(other_numbers(numbers[:4], float(numbers[4]), load_mass), numbers[4])

    numbers = np.append(model.vector, model.moving_mass)
    turned = model.with_numbers(swapped(numbers))
    ratio = (model.moving_mass + load_mass) / load_mass
    jacobian = np.zeros((5, 5))
    jacobian[0, 2] = jacobian[1, 3] = ratio
    jacobian[2, 0] = jacobian[3, 1] = 1.0 / ratio
    jacobian[4, 4] = 1.0
    jacobian[:4, 4] = [
        model.vector[2] / load_mass,
        model.vector[3] / load_mass,
        *(-turned.vector[2:] / (ratio * load_mass)),
    ]
    own, total = model.covariance, model.covariance_with_mass
    return replace(
        turned,
        covariance=None if own is None else jacobian[:4, :4] @ own @ jacobian[:4, :4].T,
        covariance_with_mass=None if total is None else jacobian @ total @ jacobian.T,
    )
