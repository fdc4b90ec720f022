"""Uncertainties in HDF5 files: written packed, read back to the last bit, whatever their names and sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.report.h5 import read_uncertainty, write_uncertainty

NAME = st.text(st.characters(codec="utf-8", exclude_characters="\0", exclude_categories=["Cs"]), min_size=1, max_size=8)
NUMBER = st.floats(allow_subnormal=True, width=64)


def stored(uncertainty: Uncertainty) -> Uncertainty:
    """Return an uncertainty as it comes back from a file that exists in memory only."""
    with h5py.File("any.h5", "w", driver="core", backing_store=False) as file:
        write_uncertainty(file.create_group("uncertainty"), uncertainty)
        return read_uncertainty(file["uncertainty"])


def same_bits(first: np.ndarray[Any, Any] | None, second: np.ndarray[Any, Any] | None) -> bool:
    """Whether two arrays are equal byte by byte, not-a-numbers and signs of zero included."""
    if first is None or second is None:
        return first is second
    return first.shape == second.shape and first.tobytes() == second.tobytes()


def assert_same(first: Uncertainty, second: Uncertainty) -> None:
    """Compare two uncertainties bit by bit."""
    assert len(first.random) == len(second.random)
    for one, other in zip(first.random, second.random, strict=True):
        assert (one.label, one.type) == (other.label, other.type)
        assert same_bits(one.covariance, other.covariance)
        assert same_bits(one.dof, other.dof)
    assert len(first.influences) == len(second.influences)
    for a, b in zip(first.influences, second.influences, strict=True):
        assert (a.name, a.label, a.u, a.unit, a.scope, a.type) == (b.name, b.label, b.u, b.unit, b.scope, b.type)
        assert same_bits(a.effect, b.effect)


@st.composite
def uncertainties(draw: st.DrawFn) -> Uncertainty:
    """Uncertainties of any size, with equal labels, empty lists of influences, infinities and not-a-numbers."""
    lines, size = draw(st.integers(1, 3)), 2 * draw(st.integers(1, 3))
    covariance = arrays(np.float64, (lines, size, size), elements=NUMBER)
    freedom = st.none() | arrays(np.float64, lines, elements=NUMBER)
    kind = st.sampled_from(["A", "B"])
    random = draw(st.lists(st.builds(Contribution, NAME, kind, covariance, freedom), min_size=1, max_size=4))
    effect = arrays(np.float64, (lines, size), elements=NUMBER)
    scope = st.sampled_from(["recording", "mounting", "rig"])
    influence = st.builds(Influence, NAME, NAME, st.floats(0.0, 1.0), NAME, effect, scope, kind)
    influences = draw(st.lists(influence, max_size=4, unique_by=lambda i: i.name))
    return Uncertainty(tuple(random), tuple(influences))


@settings(max_examples=30, deadline=None)
@given(uncertainties())
@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_what_is_read_is_what_was_written(uncertainty: Uncertainty) -> None:
    assert_same(uncertainty, stored(uncertainty))


def test_contributions_keep_their_order_and_names_with_slashes() -> None:
    labels = ("z", "a", "stereo top/left: noise", "stereo top_left: noise", "a")
    whole = Uncertainty(tuple(Contribution(label, "A", np.eye(2)[None] * k) for k, label in enumerate(labels)))
    back = stored(whole)
    assert [part.label for part in back.random] == list(labels)
    assert_same(whole, back)


def test_the_covariance_of_everything_stands_beside(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noise = Contribution("noise", "A", np.tile(np.eye(4), (2, 1, 1)), np.array([7.0, np.inf]))
    clock = Influence("clock", "time", 1e-6, "s", rng.standard_normal((2, 4)), "recording")
    whole = Uncertainty((noise,), (clock,))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        write_uncertainty(file.create_group("u"), whole)
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["u/covariance"][()], whole.covariance)
        effect = file["u/effect"][()]
        assert np.allclose(
            file["u/random/noise/covariance"][()] + np.einsum("eki,ekj->kij", effect, effect), whole.covariance
        )
        assert file["u/scope"].asstr()[()].tolist() == ["recording"]


@pytest.mark.parametrize(("field", "found"), [("scope", "planet"), ("type", "C")])
def test_a_text_that_means_nothing_is_refused(field: str, found: str) -> None:
    influence = Influence("a", "a", 1.0, "m", np.zeros((1, 2)))
    with h5py.File("any.h5", "w", driver="core", backing_store=False) as file:
        write_uncertainty(file.create_group("u"), Uncertainty((Contribution("n", "A", np.eye(2)[None]),), (influence,)))
        file["u"][field][0] = found
        with pytest.raises(ValueError, match=f"{field}: expected one of"):
            read_uncertainty(file["u"])
