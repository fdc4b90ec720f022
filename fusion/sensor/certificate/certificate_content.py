"""Content of a certificate: values, budgets, equipment, conditions and statements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date as Date
from pathlib import Path
from typing import Literal

import numpy as np

from fusion.campaign.curve import CurvePoint
from fusion.campaign.recording_results import SensorFacts
from fusion.estimation.coverage import COVERAGE, Polar
from fusion.sensitivity.load_phasors import BudgetEntry
from fusion.sensor.certificate.certificate_form import Form
from fusion.sensor.certificate.certificate_inputs import NumberList
from fusion.sensor.certificate.certificate_traceability import TRACEABLE, CertificateShares
from shakercal._common.notices import Notice

Verdict = Literal["pass", "fail"]
SPECIMEN = "SPECIMEN"
"""Word on every page, and before the number, of a certificate that certifies nothing."""
SCOPE = (
    "The results relate only to the item calibrated, in the condition received, and to the frequencies, loads, "
    "mounting and surroundings stated. This certificate may be reproduced in full only, unless the laboratory agrees "
    "in writing."
)
SIMULATED = (
    "This is a specimen. Its recordings are simulated; no item was calibrated, and no laboratory is responsible for it."
)
UNCERTAINTY = (
    f"U is the standard uncertainty times a coverage factor k for a probability of {100 * COVERAGE:g} %, after the GUM "
    "(JCGM 100, JCGM 102). It is based on the stated uncertainties of the inputs and valid under the assumptions of "
    "the evaluation: rigid bodies, linear instruments, loads only through the sensor. k is "
)


@dataclass(frozen=True)
class CertifiedValue:
    """One value of a certificate: frequency (Hz), measured value, and U.

    U of the magnitude and of the phase (rad). U is k·u with `k` and `k_phase` of the form, and at least the stated
    capability. `has_phase`: whether magnitude and phase are determined; otherwise only the complex value and its region
    are. `amplitude`: smallest and largest amplitude of the load, N or N·m, NaN if not known.
    """

    frequency_hz: float
    element: Polar
    expanded_magnitude: float
    expanded_phase_rad: float
    k: float
    k_phase: float
    has_phase: bool
    amplitude: tuple[float, float] = (np.nan, np.nan)


@dataclass(frozen=True)
class CertifiedBudget:
    """Contributions to u of one value, whose entries have one line of one element."""

    frequency_hz: float
    value: Polar
    entries: tuple[BudgetEntry, ...]


@dataclass(frozen=True)
class CertifiedElement:
    """An element of the sensor's sensitivity over frequency: output `channel` per load `component`.

    Attributes
    ----------
    unit : of the output.
    kind : element, matrix, or ratio (output over load, without correction for other loads).
    main : whether the output belongs to the load.
    deviation : relative, with U and k, of every value; empty without a static sensitivity.
    verdicts : of every deviation; empty without a limit.
    budget : of the value of a main element with the largest relative U.
    points : of the curve, as its figure needs them.
    """

    channel: str
    component: str
    unit: str
    kind: str
    main: bool
    values: tuple[CertifiedValue, ...]
    deviation: tuple[tuple[float, float, float], ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    budget: CertifiedBudget | None = None
    points: tuple[CurvePoint, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the result."""
        if self.kind == "ratio":
            return f"Ratio of output {self.channel} to driven load {self.component}"
        return f"Sensitivity {self.channel} per {self.component}"


@dataclass(frozen=True)
class UnderlyingCertificate:
    """An underlying certificate: the inputs that refer to it, its number, laboratory and date."""

    inputs: tuple[str, ...]
    certificate: str
    laboratory: str
    day: str


@dataclass(frozen=True)
class CertifiedMass:
    """A mass above the elastic element, in kg, with U (k = 2) and certificate."""

    name: str
    mass_kg: float
    expanded_kg: float
    certificate: str


@dataclass(frozen=True)
class CertifiedLoad:
    """Masses above the elastic element in some recordings: load, further parts, internal mass."""

    recordings: tuple[str, ...]
    masses: tuple[CertifiedMass, ...]


@dataclass(frozen=True, kw_only=True)
class CertificateContent:
    """What a certificate states of results.

    Attributes
    ----------
    elements, numbers : sensitivities, or lists of single numbers.
    warnings : of the evaluation, without an acknowledgement.
    acknowledged : the first notice of each acknowledged kind, and their number.
    not_assessed : influences not included in U, in plain words; sentences end with a full stop.
    versions : of the software that computed the results.
    shares : of the variance of the value that depends most on inputs without a certificate.
    """

    title: str
    sensor: SensorFacts
    elements: tuple[CertifiedElement, ...] = ()
    numbers: tuple[NumberList, ...] = ()
    warnings: tuple[Notice, ...]
    acknowledged: tuple[tuple[Notice, int], ...] = ()
    not_assessed: tuple[str, ...]
    versions: dict[str, str]
    shares: CertificateShares | None = None

    @property
    def is_matrix(self) -> bool:
        """Whether all values are elements of matrices."""
        return bool(self.elements) and all(element.kind == "matrix" for element in self.elements)


@dataclass(frozen=True, kw_only=True)
class Certificate(CertificateContent):
    """All content of a certificate, for XML and page.

    `begin`, `end`: days of the calibration; `conditions`: name, D-SI unit, smallest and largest value; `loads`: of
    sensitivities; `down`: unit vectors of gravity in sensor axes; `centre_m`: of the load; `specimen`: whether
    recordings are simulated.
    """

    form: Form
    rig_path: Path
    recordings: tuple[str, ...]
    begin: Date
    end: Date
    procedure: str
    conditions: tuple[tuple[str, str, float, float], ...]
    sources: tuple[UnderlyingCertificate, ...]
    loads: tuple[CertifiedLoad, ...] = ()
    down: tuple[tuple[float, ...], ...] = ()
    centre_m: tuple[float, ...] = ()
    specimen: bool = False

    @property
    def number(self) -> str:
        """Return the number of the certificate; that of a specimen says so."""
        return f"{SPECIMEN} {self.form.administration.number}" if self.specimen else self.form.administration.number

    def statements(self) -> Iterator[tuple[str, str]]:
        """Yield name and text of every statement."""
        administration, capability, limit = self.form.administration, self.form.laboratory.cmc, self.form.conformity
        if self.specimen:
            yield "Specimen", SIMULATED
        yield "Scope", SCOPE
        yield (
            "Uncertainty",
            UNCERTAINTY
            + ("" if self.form.k == "effective" else "2, or if that is larger ")
            + "that of the effective degrees of freedom.",
        )
        if self.elements and (capability.magnitude or capability.phase):
            sizes = f"{100 * capability.magnitude:g} % of the magnitude and {capability.phase:g} rad of the phase"
            yield "Capability", f"No U is stated below {sizes}."
        yield "Traceability", TRACEABLE if self.shares is None else self.shares.statement
        if administration.traceability:
            yield "Traceability", administration.traceability
        if self.elements and limit is not None:
            rule = "|deviation| + U" if limit.rule == "guarded" else "|deviation|"
            yield (
                "Decision rule",
                f"A main element conforms where {rule} of its magnitude from the static sensitivity is within "
                f"{100 * limit.tolerance:g} % (ILAC-G8:09/2019, {limit.rule} acceptance).",
            )
        if self.not_assessed:
            sentences = [text for text in self.not_assessed if text.endswith(".")]
            named = "; ".join(text for text in self.not_assessed if not text.endswith("."))
            yield "Not included in U", " ".join([f"U does not include: {named}."] * bool(named) + sentences)
        if self.acknowledged:
            each = (f"{one.code}: {one.text} {one.acknowledged}." for one, _ in self.acknowledged)
            yield "Acknowledged", " ".join(each)
        if administration.remarks:
            yield "Remarks", administration.remarks


def input_words(keys: Sequence[str]) -> list[str]:
    """Return inputs in words: `rig.toml: load.mass` is the mass of the load."""
    found: dict[str, dict[str, None]] = {}
    for key in keys:
        *owners, name = key.rpartition(": ")[2].split(".")
        found.setdefault(name.replace("_", " "), {})[owners[-1] if owners else ""] = None
    return [f"{name} of {', '.join(owners)}".removesuffix(" of ") for name, owners in found.items()]
