"""The inverse of a small covariance matrix, compiled."""

from __future__ import annotations

from photogram._checks import FloatArray
from photogram._kernel import njit


@njit()
def invert(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Invert a symmetric positive definite (3, 3) by its cofactors; return whether it is one."""
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            inverse[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    determinant = matrix[0, 0] * inverse[0, 0] + matrix[0, 1] * inverse[1, 0] + matrix[0, 2] * inverse[2, 0]
    if not determinant > 0.0:
        return False
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant
    return True
