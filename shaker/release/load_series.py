"""Two masses or three: which model a series of loads supports, and the model itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import FloatArray, Notice, Severity
from shaker.release.load_fit import (
    SeriesFit,
    SeriesMasses,
    SeriesProblem,
    belonging,
    explains,
    fit_decays,
    fit_resonances,
)
from shaker.release.load_model import LoadModel
from shaker.release.load_modes import FreeDecay, Resonances

CHANCE = 0.01
"""Chance below which a rigid load is contradicted."""
NEGLIGIBLE = 1e-3
"""Deviation in % that is not worth a number."""
UNLIKELY = 3.0
"""Standard uncertainties by which a mass may differ from what is stated before the user is told."""


@dataclass(frozen=True)
class Output:
    """What was recorded: load component, output channel, its unit, static output per N or N·m, that one's u."""

    component: str
    channel: str
    unit: str
    sensitivity: float = 1.0
    u_sensitivity: float = 0.0

    @property
    def mass_unit(self) -> str:
        """Unit of what stands for a mass."""
        return "kg·m²" if self.component.startswith("M") else "kg"


@dataclass(frozen=True)
class LoadIdentification:
    """The model of a sensor and its loads, and what it rests on.

    `rigid`, `elastic`: fits of the two-mass and of the three-mass model to the resonances, none of the latter where
    they cannot tell it; `chosen`: of the model that the data support, fitted to the records where `from_records`, more
    than one where the data cannot tell solutions apart, the stiffest coupling first. `models`: as `chosen`; `reason`:
    why this structure.
    """

    output: Output
    measured: Resonances
    masses: SeriesMasses
    rigid: SeriesFit
    elastic: tuple[SeriesFit, ...]
    chosen: tuple[SeriesFit, ...]
    from_records: bool
    models: tuple[LoadModel, ...]
    reason: str
    notices: tuple[Notice, ...]

    @property
    def model(self) -> LoadModel:
        """The model, the first one where there are several solutions."""
        return self.models[0]


def identify_loads(
    measured: Resonances,
    masses: SeriesMasses,
    output: Output,
    decays: tuple[FreeDecay, ...] = (),
    noise: FloatArray | None = None,
) -> LoadIdentification:
    """Return the model that resonances of R records support, fitted to their `decays` where these are given.

    Three masses are chosen where a second mode was seen, or where a rigid load contradicts the first ones (chance below
    1 in 100); second modes that no coupling explains are left out. Where resonances scatter about the model beyond what
    is stated, and the model leaves more of the records than noise, the fit to the resonances, which knows of that
    scatter, takes the place of the fit to the records. `noise` (R,) of the records, in output units.

    >>> import numpy as np
    >>> from shaker import identify_loads
    >>> from shaker.release.load_fit import stated_masses
    >>> from shaker.release.load_modes import stated_resonances
    >>> from shaker.release.load_series import Output
    >>> load = np.array([0.0, 0.5, 1.0, 2.0])  # kg on 0.3 kg that move, on a spring of 4 N/µm
    >>> seen = stated_resonances(np.sqrt(4e6 / (0.3 + load)) / (2 * np.pi))
    >>> found = identify_loads(seen, stated_masses(0.3, 0.0, load), Output("Fz", "Fz", "V"))
    >>> print(f"{found.model.stiffness:.3g} N/m")
    4e+06 N/m
    """
    seen = measured
    measured, foreign = belonging(measured, masses)
    rigid = fit_resonances(measured, masses, rigid=True)[0]
    told = np.isfinite(measured.frequency_hz) & np.stack([np.ones_like(masses.load), masses.load], axis=1).astype(bool)
    enough = int(told.sum()) >= 2 and bool(np.any(masses.load > 0))
    elastic = fit_resonances(measured, masses, rigid=False) if enough else ()
    supported, reason = _supports(measured, masses, rigid, elastic, output.mass_unit)
    chosen = elastic if supported else (rigid,)
    from_records = False
    if decays and noise is not None:
        problem = SeriesProblem(measured, masses, rigid=not supported)
        joint = tuple(fit_decays(decays, noise, problem, fit) for fit in chosen)
        from_records = not any(chosen[0].scatter) or explains(decays, noise, problem, joint[0])
        chosen = tuple(replace(fit, scatter=(0.0, 0.0)) for fit in joint) if from_records else chosen
    if supported:
        chosen = tuple(sorted(chosen, key=lambda fit: -float(fit.numbers[2])))
    models = tuple(_model(fit, masses, output, n, len(chosen)) for n, fit in enumerate(chosen, 1))
    told = _said(masses, output, chosen[0], models, bool(np.any(measured.u_frequency_hz[:, 0] > 0)))
    if foreign:
        places = [f"{seen.frequency_hz[r, 1]:.5g} Hz with {_mass(masses.load[r], output.mass_unit)}" for r in foreign]
        told.insert(0, ("warning", f"modes that no coupling of the load explains are left out: {', '.join(places)}"))
    told.insert(bool(foreign), ("info", f"{'three' if supported else 'two'} masses: {reason}"))
    notices = tuple(Notice(severity, text, output.component) for severity, text in told)
    return LoadIdentification(output, measured, masses, rigid, elastic, chosen, from_records, models, reason, notices)


def _supports(
    measured: Resonances, masses: SeriesMasses, rigid: SeriesFit, elastic: tuple[SeriesFit, ...], unit: str
) -> tuple[bool, str]:
    """Whether the data support three masses, and why."""
    if not elastic:
        return False, "one resonance of one load cannot tell the coupling's stiffness: the load is taken as rigid"
    seen = np.isfinite(measured.frequency_hz[:, 1]) & (masses.load > 0)
    missed, left = _largest(measured, masses, rigid, unit), _largest(measured, masses, elastic[0], unit)
    told = f"two masses miss the resonance by {missed}, three by {left}"
    if seen.any():
        place = int(np.flatnonzero(seen)[0])
        second = f"{measured.frequency_hz[place, 1]:.5g} Hz with {_mass(masses.load[place], unit)}"
        return True, f"a second resonance is seen ({second}), which a rigid load does not have; {told}"
    if _contradicted(measured, masses, rigid, elastic[0]):
        return True, f"a rigid load contradicts the resonances: {told}"
    return False, f"a rigid load explains the resonances: {told}"


def _contradicted(measured: Resonances, masses: SeriesMasses, rigid: SeriesFit, elastic: SeriesFit) -> bool:
    """Whether two masses fit worse than three by more than chance explains."""
    from scipy.special import chdtrc, fdtrc

    relative = measured.u_frequency_hz[:, 0] / measured.frequency_hz[:, 0]
    variance = relative**2 + elastic.scatter[0] ** 2
    if np.any(variance == 0.0):
        return False
    squares = [
        float(np.sum(np.log(fit.frequency_hz[:, 0] / measured.frequency_hz[:, 0]) ** 2 / variance))
        for fit in (rigid, elastic)
    ]
    gain = max(squares[0] - squares[1], 0.0)
    if elastic.scatter[0] > 0.0:
        return bool(fdtrc(1, elastic.dof[0], gain) < CHANCE)
    return bool(chdtrc(1, gain) < CHANCE)


def _largest(measured: Resonances, masses: SeriesMasses, fit: SeriesFit, unit: str) -> str:
    """The largest deviation of a fit's first resonances, and with which load."""
    deviation = 100.0 * (fit.frequency_hz[:, 0] / measured.frequency_hz[:, 0] - 1.0)
    place = int(np.argmax(np.abs(deviation)))
    size = float(abs(deviation[place]))
    told = f"{size:.2g} %" if size > NEGLIGIBLE else f"less than {NEGLIGIBLE:g} %"
    return f"{told} with {_mass(masses.load[place], unit)}"


def _mass(load: float, unit: str) -> str:
    """A load mass in words."""
    return f"a load of {load:.4g} {unit}" if load > 0 else "no load"


def _model(fit: SeriesFit, masses: SeriesMasses, output: Output, number: int, count: int) -> LoadModel:
    """The model of a fit, with covariance for given masses and with that of the masses."""
    size = len(fit.numbers)
    own, total = None, None
    if fit.covariance is not None:
        whole = fit.covariance
        inner = np.eye(size, len(whole))
        turn = np.vstack([inner, np.concatenate([np.zeros(size), masses.moving_effect])])
        total = turn @ whole @ turn.T
        across = whole[:size, size:]
        own = whole[:size, :size] - (across @ np.linalg.solve(whole[size:, size:], across.T) if across.size else 0.0)
    k, c, *coupling = (float(number) for number in fit.numbers)
    moving, _ = masses.at(fit.deviates)
    return LoadModel(
        component=output.component,
        channel=output.channel,
        unit=output.unit,
        moving_mass=moving,
        stiffness=k,
        damping=c,
        coupling_stiffness=coupling[0] if coupling else None,
        coupling_damping=coupling[1] if coupling else None,
        sensitivity=output.sensitivity,
        u_moving_mass=masses.u_moving if total is None else float(np.sqrt(total[-1, -1])),
        covariance=own,
        u_sensitivity=output.u_sensitivity,
        covariance_with_mass=total,
        load_masses=tuple(float(mass) for mass in masses.load),
        solution=number,
        solutions=count,
    )


def _said(
    masses: SeriesMasses, output: Output, fit: SeriesFit, models: tuple[LoadModel, ...], stated: bool
) -> list[tuple[Severity, str]]:
    """What the user should know: solutions that cannot be told apart, scatter about the model, masses contradicted."""
    told: list[tuple[Severity, str]] = []
    if len(models) > 1:
        unit = "N·m/rad" if output.component.startswith("M") else "N/m"
        pairs = " or ".join(f"k = {m.stiffness:.4g}, k_L = {m.coupling_stiffness:.4g} {unit}" for m in models)
        bare = " or ".join(f"{abs(m.poles(0.0)[0]) / (2.0 * np.pi):.5g} Hz" for m in models)
        text = (
            f"the recorded loads cannot tell {len(models)} solutions apart: {pairs}; all are given. Another load mass "
            f"does: without load the resonance would be {bare}"
        )
        told.append(("warning", text))
    for tau, what, known in zip(fit.scatter, ("resonances", "damping ratios"), (stated, True), strict=True):
        if tau > 0.0 and known:
            text = (
                f"{what} scatter about the model by {100.0 * tau:.2g} % more than their uncertainties explain: U holds "
                "it, and the model is fitted to them, not to the records"
            )
            told.append(("warning", text))
        elif tau > 0.0:
            text = f"no uncertainties of the {what} are stated: U follows from their scatter of {100.0 * tau:.2g} %"
            told.append(("info", text))
    if fit.covariance is None:
        text = "neither stated uncertainties nor more resonances than unknowns: no U can be given"
        told.append(("warning", text))
    for name, value in zip(masses.names, fit.deviates, strict=True):
        if abs(value) > UNLIKELY:
            told.append(("warning", f"{name}: the resonances ask for {value:+.1f} standard uncertainties"))
    return told
