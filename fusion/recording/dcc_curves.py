"""Lists over frequency in a Digital Calibration Certificate: columns, signs, units."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import InputError
from fusion.recording.dcc import NO_UNIT, CalibrationCertificate, CertifiedQuantity
from fusion.recording.dsi import BASE, LEVEL, NONE, Unit, parse_unit
from fusion.recording.values import describe
from shakercal._common.arrays import ComplexArray, FloatArray

HERTZ = parse_unit(r"\hertz").dimension
ELECTRICAL = tuple(parse_unit(unit).dimension for unit in (r"\volt", r"\ampere", r"\coulomb"))
RATIOS = {tuple(a - b for a, b in zip(one, other, strict=True)) for one in ELECTRICAL for other in ELECTRICAL}
"""Dimensions of amplifier gains, 1 included."""
AMPERE = BASE.index("A")
FREQUENCY = ("frequen", "frequên", "fréquen", "frecuen", "table index")
ANGULAR = re.compile(
    r"(angular|circular) frequenc|(kreis|winkel)frequenz|fréquence angulaire|frecuencia angular|frequenza angolare"
    r"|pulsation|pulsazione|pulsación|\bomega\b|ω"
)
"""Names of 2πf."""
MAGNITUDE = (
    ("magnitude",),
    ("sensitiv", "gain", "amplitude", "empfindlich", "verstärk", "betrag", "module"),
    ("measured value",),
)
"""Words for the magnitude if several columns are possible, in order of priority."""
PHASE = (("phase", "fase", "argument"), ("measured value",))
LAG = re.compile(r"\b(phase)?lag(s|ging)?\b|verzug|nacheil")
UNSURE = re.compile(r"delay|verzögerung|retard|retras|ritard|atras|negativ|minus")
"""Names of a possible lag, or of its sign."""
LEAD = re.compile(r"\b(phase)?lead(s|ing)?\b|voreil|advance|avance|adelant|anticip|avanç")
UNAMBIGUOUS_SIGN = "a phase that is positive if the output leads, or a phase lag with positive numbers"
DEVIATION = re.compile(
    r"uncertain|unsicherheit|incertitude|incertidumbre|incertezza|incerteza|deviation|abweichung|écart|desviación"
    r"|deviazione|\berror|coverage|überdeckung"
)
"""Names of columns that qualify a value."""
LOSS = re.compile(r"attenuation|\bloss|dämpfung|affaiblissement|atenua|attenuazione")
"""Names of quantities that are large if the response is small."""


@dataclass(frozen=True)
class CertifiedCurve:
    """A complex quantity over N frequencies, Hz: magnitude and phase, rad, with u.

    u = U/k with k of at most 2, so that 2·u is the stated U. `phase_rad` with its u is NaN if it is not stated. `value`
    (N,) and `covariance` (N, 2, 2) exist if complex values are stated. NaN was not measured. `problem`: the error of an
    unusable one, which has no values, else None.
    """

    name: str
    types: tuple[str, ...]
    ids: tuple[str, ...]
    unit: Unit
    frequency_hz: FloatArray
    magnitude: FloatArray
    u_magnitude: FloatArray
    phase_rad: FloatArray
    u_phase_rad: FloatArray
    value: ComplexArray | None = None
    covariance: FloatArray | None = None
    problem: InputError | None = None

    def usable(self) -> CertifiedCurve:
        """Return the curve; raise its error."""
        if self.problem is not None:
            raise self.problem
        return self


def curve_named(certificate: CalibrationCertificate, result: str) -> CertifiedCurve:
    """Return the list over frequency of a name, or the only one.

    `InputError` if there are none or several.
    """
    every = list(curves(certificate))
    fitting = [curve for curve in every if not result or result in (curve.name, *curve.types, *curve.ids)]
    if len(fitting) != 1:
        available = ", ".join(f'"{curve.name}"' for curve in every[:8])
        found = f"{len(fitting)} of {available}" if every else "no list over frequency"
        key = f'result "{describe(result, plain=True)}"' if result else "dcc:results"
        raise certificate.refusal(key, found, "one result over frequency, by its id, name or type")
    return fitting[0].usable()


def curves(certificate: CalibrationCertificate) -> Iterator[CertifiedCurve]:
    """Yield every list over frequency of a certificate, including unusable ones."""
    groups: dict[tuple[int, str], list[CertifiedQuantity]] = {}
    for quantity in certificate.quantities:
        for row in dict.fromkeys(quantity.rows) or ("",):
            groups.setdefault((quantity.group, row), []).append(quantity.at_row(row) if row else quantity)
    for members in groups.values():
        frequencies = [q for q in members if q.unit.dimension in (HERTZ, ()) and any(w in q.words for w in FREQUENCY)]
        plain = [q for q in members if q.unit.dimension == HERTZ and not q.unit.angle]
        frequencies = frequencies or (plain if len(plain) == 1 else [])
        rest = [q for q in members if not any(q is one for one in frequencies)]
        if not frequencies or not rest:
            continue
        try:
            curve = _curve(certificate, frequencies, rest)
        except InputError as error:
            if not any(q.listed for q in members):
                continue
            none = np.empty(0)
            curve = CertifiedCurve("", (), (), NO_UNIT, none, none, none, none, none, problem=error)
        if curve is not None:
            yield replace(
                curve,
                name=members[0].result or curve.name or members[0].name,
                types=tuple(dict.fromkeys(word for q in members for word in q.types)),
                ids=tuple(dict.fromkeys(i for q in members for i in q.ids)),
            )


def _of_transducer(quantity: CertifiedQuantity) -> CertifiedQuantity | None:
    """Return a quantity in V, A or C per mechanical unit, else None."""
    for unit in filter(None, (quantity.unit, quantity.unit.other)):
        if unit.dimension and unit.dimension[AMPERE] and unit.dimension not in (*RATIOS, *ELECTRICAL):
            return quantity.in_one_of((unit.dimension,))
    return None


def in_hertz(certificate: CalibrationCertificate, quantity: CertifiedQuantity) -> CertifiedQuantity:
    """Return frequencies in Hz; angular ones (rad/s, or 1/s by name) are divided by 2π."""
    angular = ANGULAR.search(quantity.words) is not None
    if angular and "hertz" in quantity.unit.text.lower():
        raise certificate.refusal(quantity.where, f"an angular frequency in {quantity.unit.text}", "rad/s, or f in Hz")
    if quantity.unit.angle not in (0, 1):
        raise certificate.refusal(quantity.where, quantity.unit.text, "a frequency in Hz or rad/s")
    if not angular and not quantity.unit.angle:
        return quantity
    turn = 1.0 / (2.0 * np.pi)
    return replace(quantity, value=quantity.value * turn, expanded=quantity.expanded * turn, unit=parse_unit(r"\hertz"))


def _one_of(
    certificate: CalibrationCertificate, what: str, found: Sequence[CertifiedQuantity], words: Sequence[Sequence[str]]
) -> CertifiedQuantity | None:
    """Return the one quantity with distinctive words, None if there is none.

    Columns of deviations and uncertainties are ignored.
    """
    found = [q for q in found if not DEVIATION.search(" ".join(q.names).lower())]
    for group in words:
        named = [q for q in found if any(word in q.words for word in group)]
        found = named or found
    found = [q for q in found if q.unit.dimension] or found
    if len(found) > 1:
        columns = ", ".join(f'"{q.name}"' for q in found[:4])
        raise certificate.refusal(
            f'result "{found[0].result}"', f"{len(found)} ({columns})", f"one column with the {what}"
        )
    return found[0].usable() if found else None


def _curve(
    certificate: CalibrationCertificate,
    frequencies: Sequence[CertifiedQuantity],
    rest: Sequence[CertifiedQuantity],
) -> CertifiedCurve | None:
    """Return the list over frequency of some quantities, None if they are none."""
    real = [q for q in rest if q.is_real]
    named = [q for q in real if q.unit.dimension in (NONE, ()) and any(word in q.words for word in PHASE[0])]
    turns = named or [q for q in real if q.unit.dimension == NONE and q.unit.angle == 1]
    sizes = [q for q in real if not any(q is turn for turn in turns)]
    unknown = [q for q in sizes if not q.unit.dimension]
    responses = [[one for q in sizes if (one := q.in_one_of(group)) is not None] for group in (RATIOS, (LEVEL,))]
    transducers = [one for q in sizes if (one := _of_transducer(q)) is not None]
    sizes = [*(transducers or responses[0] or responses[1]), *unknown] or sizes
    size = _one_of(certificate, "magnitude", sizes, MAGNITUDE)
    whole = next((q for q in rest if not q.is_real), None)
    if size is not None and whole is not None and np.isnan(size.value).any():
        size = None  # the complex values are complete
    if size is None and whole is None:
        return None
    frequency = _one_of(
        certificate, "frequencies", frequencies, (("table index",), ("measured", "actual"), ("nominal",))
    )
    assert frequency is not None
    frequency_hz = np.asarray(in_hertz(certificate, frequency).value.real)
    if size is None:
        assert whole is not None
        return _of_complex(certificate, frequency_hz, whole)
    turn = _one_of(certificate, "phase", turns, PHASE)
    for column in filter(None, (frequency, turn)):
        if len(column.value) != len(size.value):
            expected = f"{len(size.value)}, the number of {size.name or 'the values'}"
            raise certificate.refusal(column.where, f"{len(column.value)} numbers", expected)
    size = _as_ratio(certificate, size)
    none = np.full(len(size.value), np.nan)
    phase, u_phase = (none, none) if turn is None else (_phase(certificate, turn), _standard(certificate, turn))
    exact = whole is not None and whole.covariance is not None and whole.unit.dimension == size.unit.dimension
    exact = exact and whole is not None and len(whole.value) == len(size.value)
    return CertifiedCurve(
        size.name, (), (), size.unit, frequency_hz, size.value.real, _standard(certificate, size), phase, u_phase,
        value=whole.value if exact and whole is not None else None,
        covariance=whole.covariance if exact and whole is not None else None,
    )  # fmt: skip


def _of_complex(
    certificate: CalibrationCertificate, frequency_hz: FloatArray, whole: CertifiedQuantity
) -> CertifiedCurve:
    """Return a list with complex values only."""
    if len(frequency_hz) != len(whole.value):
        raise certificate.refusal(whole.where, f"{len(whole.value)} numbers", f"{len(frequency_hz)}, one per frequency")
    if whole.covariance is None:
        raise certificate.refusal(whole.where, "no uncertainty", "their covariance, in their unit squared")
    magnitude, phase = np.abs(whole.value), np.angle(whole.value)
    along = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    across = np.stack([-np.sin(phase), np.cos(phase)], axis=1)
    u_magnitude = np.sqrt(np.einsum("ni,nij,nj->n", along, whole.covariance, along))
    u_phase = np.sqrt(np.einsum("ni,nij,nj->n", across, whole.covariance, across)) / np.where(magnitude, magnitude, 1)
    return CertifiedCurve(
        whole.name, (), (), whole.unit, frequency_hz, magnitude, u_magnitude, phase, u_phase, whole.value,
        whole.covariance,
    )  # fmt: skip


def _as_ratio(certificate: CalibrationCertificate, size: CertifiedQuantity) -> CertifiedQuantity:
    """Return a magnitude as a ratio, converted from levels (field quantities, re 1)."""
    if size.unit.dimension != LEVEL:
        return size
    if LOSS.search(f"{size.words} {size.description.lower()}"):
        raise certificate.refusal(size.where, f"a loss in {size.unit.text}", "a gain")
    ratio = np.exp(size.value.real)
    return replace(size, value=ratio + 0j, expanded=size.expanded * ratio, unit=parse_unit(r"\one"))


def _phase(certificate: CalibrationCertificate, turn: CertifiedQuantity) -> FloatArray:
    """Return phases in rad, positive if the output leads; lags change their sign."""
    if not (turn.unit.angle == 1 or turn.unit.factor == 1.0):
        raise certificate.refusal(turn.where, turn.unit.text, "a phase in rad or degrees")
    about = turn.description.lower()
    try:
        if LAG.search(about) and not LAG.search(turn.words) and ("positiv" in about or "negativ" not in about):
            raise ValueError(f'"{turn.description[:60]}"')  # a sign convention in words
        return leading_phase(np.asarray(turn.value.real), turn.expanded, turn.words)
    except ValueError as error:
        raise certificate.refusal(turn.where, str(error), UNAMBIGUOUS_SIGN) from error


def leading_phase(phase_rad: FloatArray, expanded_rad: FloatArray, words: str) -> FloatArray:
    """Return phases that are positive if the output leads, by their name.

    `words`: the name in small letters. Raises `ValueError` with the finding if the name, or negative numbers of a lag,
    make the sign ambiguous.
    """
    lag, lead, unsure = (pattern.search(words) is not None for pattern in (LAG, LEAD, UNSURE))
    if (lag and (lead or unsure)) or (unsure and not lead):
        raise ValueError(f'"{words[:60]}"')
    if lag and np.any(phase_rad < -np.nan_to_num(expanded_rad)) and not np.any(phase_rad > 0.0):
        raise ValueError(f"a lag of {np.nanmin(phase_rad):g} rad")
    return -phase_rad if lag else phase_rad


def _standard(certificate: CalibrationCertificate, quantity: CertifiedQuantity) -> FloatArray:
    """Return u of every value; `InputError` if no U is stated."""
    if not np.any(np.isfinite(quantity.expanded)):
        raise certificate.refusal(quantity.where, "no uncertainty", "U with its coverage factor")
    return np.asarray(quantity.expanded / np.minimum(quantity.k, 2.0))
