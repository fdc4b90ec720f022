"""Which components of a pose the evidence leaves open, told by name."""

from __future__ import annotations

import numpy as np

from photogram._checks import FloatArray

LIMIT = 0.1
"""Standard uncertainty (m, rad) from which a component counts as open: nothing is evaluated with such a pose."""
_SAME = 0.02  # sine of the angle below which a direction goes by the name of an axis
_PURE = 1e-2  # share below which a displacement counts as one without rotation


class OpenPose(ValueError):
    """The evidence leaves components of the pose open; `components` names them."""

    def __init__(self, components: tuple[str, ...]) -> None:
        self.components = components
        turns = any(name.startswith("rotation") for name in components)
        shifts = any(name.startswith("position") for name in components)
        cures = ["three points or faces, or a target at a known pose"]
        cures += ["a motion in another direction"] if turns else []
        cures += ["a rotation axis that is not parallel to others"] if shifts else []
        verb = "is" if len(components) == 1 and " and " not in components[0] else "are"
        text = f"{' and '.join(components)} {verb} open: add {', '.join(cures)}, or a pose known before"
        super().__init__(text)


def open_components(information: FloatArray) -> tuple[str, ...]:
    """Return the names of the components that an information matrix (6, 6) leaves open, empty if none.

    Open are the eigenvectors of the information, in units of `LIMIT`, whose eigenvalue is below 1, which is a standard
    uncertainty above `LIMIT`. Shifts among them are told apart from what turns.
    """
    values, vectors = np.linalg.eigh(information * LIMIT**2)
    basis = vectors[:, values < 1.0]
    if not basis.shape[1]:
        return ()
    left, singular, right = np.linalg.svd(basis[3:])
    turning = int(np.count_nonzero(singular > _PURE))
    shifts = (basis @ right[turning:].T)[:3]
    found = [f"rotation about {_axes(left[:, :turning])}"] if turning else []
    if shifts.shape[1]:
        found.append(f"position along {_axes(np.linalg.svd(shifts, full_matrices=False)[0])}")
    return tuple(found)


def _axes(basis: FloatArray) -> str:
    """Return the name of the directions that orthonormal columns (3, d) span."""
    reach = np.linalg.norm(basis, axis=1)
    inside = [axis for axis, length in zip("xyz", reach, strict=True) if length > 1.0 - _SAME**2]
    if len(inside) == basis.shape[1]:
        return " and ".join([", ".join(inside[:-1]), inside[-1]] if len(inside) > 1 else inside)
    if basis.shape[1] == 1:
        return f"({', '.join(f'{x:.3g}' for x in _upright(basis[:, 0]))})"
    normal = np.linalg.svd(basis)[0][:, 2]
    return f"every direction across ({', '.join(f'{x:.3g}' for x in _upright(normal))})"


def _upright(direction: FloatArray) -> FloatArray:
    """Return a direction with its largest component positive and rounding removed."""
    turned = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return np.asarray(np.where(np.abs(turned) < _SAME, 0.0, turned))
