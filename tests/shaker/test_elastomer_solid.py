"""The solid model against the frame, closed forms, and a solution of the whole element without symmetry."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from contracts import refused

from shaker.elastomer.frame import RigidPart, block, solve_frame
from shaker.elastomer.geometry import CrossBeams, ElasticMaterial, beam_stiffness
from shaker.elastomer.solid import SolidBlock, SolidModel, mesh_change, solve_solid

pytest.importorskip("skfem")
ALUMINIUM = ElasticMaterial(72e9, 0.3, 2820.0)
ELEMENT = CrossBeams(ALUMINIUM, 0.064, 0.0038, 0.0038, 0.001, 0.032, 0.0038)
SLENDER = CrossBeams(ALUMINIUM, 0.14, 0.002, 0.003, 0.001, 0.05, 0.003)
BLOCK = SolidBlock(0.014, 0.008, 0.0, 2820.0)


@pytest.fixture(scope="module")
def coarse() -> SolidModel:
    """The element on its coarsest mesh."""
    return solve_solid(ELEMENT, BLOCK, 1)


def _whole_element_hz() -> np.ndarray:
    """Six frequencies of the whole element on a mesh of its own, made and solved here."""
    from scipy.sparse.linalg import eigsh
    from skfem import Basis, BilinearForm, ElementHex2, ElementVector, MeshHex, asm
    from skfem.helpers import dot
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    size, thickness, longest, inner, outer = 0.014, 0.008, 0.006, 0.0315, 0.0325
    breaks = [0.0, 0.0019, size, 0.016, inner, outer]
    lines = np.unique(np.array([-b for b in breaks] + breaks))
    pieces = [np.linspace(a, b, int(np.ceil((b - a) / longest - 1e-9)) + 1) for a, b in pairwise(lines)]
    flat = np.unique(np.round(np.concatenate(pieces), 15))
    up = np.unique(np.array([-thickness / 2, -0.0019, 0.0019, thickness / 2]))
    mesh = MeshHex.init_tensor(flat, flat, up)
    x, y, z = np.abs(mesh.p[:, mesh.t].mean(axis=1))
    beam, inside = z < 0.0019, (x < size) & (y < size)
    for along, across_axis in ((x, y), (y, x)):
        inside |= beam & (along > size) & (along < inner) & (across_axis < 0.0019)
        inside |= beam & (along > inner) & (along < outer) & (across_axis < 0.016)
    mesh = mesh.restrict(np.flatnonzero(inside))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)

    @BilinearForm
    def inertia(u, v, _):  # type: ignore[no-untyped-def]
        return 2820.0 * dot(u, v)

    stiffness, mass = asm(linear_elasticity(*lame_parameters(72e9, 0.3)), basis), asm(inertia, basis)
    x, y, _ = np.abs(basis.doflocs)
    fixed = (np.abs(y - 0.016) < 1e-9) & (x > inner - 1e-9) | (np.abs(x - 0.016) < 1e-9) & (y > inner - 1e-9)
    free = np.flatnonzero(~fixed)
    squared = eigsh(stiffness[free][:, free].tocsc(), k=6, M=mass[free][:, free].tocsc(), sigma=0.0)[0]
    return np.sqrt(np.sort(squared)) / (2.0 * np.pi)


@pytest.mark.slow
def test_quarter_with_symmetry_is_the_whole_element(coarse):
    assert np.sort(coarse.frequency_hz) == pytest.approx(_whole_element_hz(), rel=1e-7)


@pytest.mark.slow
def test_solid_is_near_the_frame_and_converges_from_above(coarse):
    models = coarse, solve_solid(ELEMENT, BLOCK, 2)
    frame = solve_frame(ELEMENT, 0.014, block(2820.0, 0.014, 0.008))
    assert frame.modes.frequency_hz == pytest.approx(models[1].frequency_hz, rel=0.10)
    assert frame.stiffness == pytest.approx(models[1].stiffness, rel=0.15)
    assert models[1].frequency_hz == pytest.approx([1457, 1457, 1482, 3894, 3894, 4688], rel=0.015)
    assert np.all(mesh_change(models) < 0.0)
    assert np.all(mesh_change(models) > -0.03)


@pytest.mark.slow
def test_slender_beams_and_a_stiff_platform_lie_between_lengths_to_axes_and_to_faces():
    part = RigidPart(0.5, 0.01, np.array([4e-5, 4e-5, 6e-5]))
    solid = solve_solid(SLENDER, SolidBlock(0.02, 0.01, 0.0, 0.0, part, stiffening=1e3), 1)
    clear = replace(SLENDER, span_m=SLENDER.span_m - 0.001, compliant_length_m=SLENDER.compliant_length_m - 0.002)
    low, high = (beam_stiffness(beams, 0.02) for beams in (SLENDER, clear))
    assert low.x < solid.stiffness[0] < 1.02 * high.x < 1.2 * low.x
    assert low.z < solid.stiffness[2] < 1.02 * high.z < 1.2 * low.z
    soft, hard = (solve_frame(beams, 0.02, part).modes.frequency_hz for beams in (SLENDER, clear))
    assert np.all((0.99 * soft < solid.frequency_hz) & (solid.frequency_hz < 1.01 * hard))


def test_shapes_follow_their_names(coarse):
    centre = int(np.argmin(np.linalg.norm(coarse.vertex_m - [0.0, 0.0, 0.004], axis=1)))
    corner = int(np.argmin(np.linalg.norm(coarse.vertex_m - [0.014, 0.014, 0.004], axis=1)))
    for axis in range(3):
        moved = coarse.motion[axis, centre]
        assert moved[axis] > 10.0 * np.abs(np.delete(moved, axis)).max()
    z = coarse.motion[:, corner, 2]
    assert z[3] > 0.0  # Rx lifts y > 0
    assert z[4] < 0.0  # Ry lowers x > 0
    assert coarse.motion[5, corner, 1] > 0.0
    assert coarse.motion[5, corner, 0] < 0.0


def test_geometries_that_cannot_be_meshed_are_refused():
    refused("^compliant_length_m: ", solve_solid, replace(ELEMENT, compliant_length_m=0.07), BLOCK, 1)
    refused("^beam_width_m: ", solve_solid, replace(ELEMENT, beam_width_m=0.03), BLOCK, 1)
    refused("^half_size_m: ", solve_solid, ELEMENT, SolidBlock(0.0317, 0.008, 0.0, 2820.0), 1)
    refused("^height_m: ", solve_solid, ELEMENT, SolidBlock(0.014, 0.008, 0.006, 2820.0), 1)
    refused("^attached: ", SolidBlock, 0.01, 0.004, 0.0, 0.0)
    refused("^models: ", mesh_change, ())
