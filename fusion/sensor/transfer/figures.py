"""Figure of a transfer function: magnitude, phase, uncertainty and coherence over frequency."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from fusion.estimation.uncertainty import typeset
from fusion.report.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
    power_text,
)
from shaker.arrays import ComplexArray, FloatArray
from shaker.identification.oscillator import Resonance

RASTER_ABOVE = 6000  # lines from which curves are drawn as an image
WIDE_BAND = 8.0  # ratio of the band's ends from which frequency is drawn logarithmically
LARGEST_PERCENT = 100.0
COVERAGE = 2.0


@dataclass(frozen=True)
class TransferCurve:
    """One response over a reference at K lines: value (K,), covariances (K, 2, 2) in all and of noise alone."""

    response: str
    reference: str
    unit: str
    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    random_covariance: FloatArray
    coherence: FloatArray
    resonances: tuple[tuple[Resonance, tuple[float, float]], ...]


def draw_transfer(curve: TransferCurve) -> Picture:
    """Magnitude and phase with U (k = 2), relative uncertainty with its random part, and coherence."""
    name = f"transfer-{curve.response}-{curve.reference}"
    with drawing(name):
        figure = new_figure(7.4)
        panels = figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [2.3, 1.5, 1.2, 0.9]})
        _draw_magnitude(panels[0], curve)
        _draw_phase(panels[1], curve)
        _draw_uncertainty(panels[2], curve)
        _draw_coherence(panels[3], curve)
        for axes in panels:
            axes.set_rasterization_zorder(3 if len(curve.value) > RASTER_ABOVE else -1)
        _frequency_axis(panels[-1], curve.frequency_hz)
        lay_out(figure, panels, top=0.24, gap=(0.5, 0.3), left=0.78, label=0.58)
        fitted = " Red: the oscillators fitted, over the lines that were used." if curve.resonances else ""
        caption = (
            f"Bands: expanded uncertainty U (k = 2), which the third panel shows by itself.{fitted} A coherence below "
            "one tells of noise, of other sources or of a structure that is not linear."
        )
        return finish(figure, name, f"{curve.response} over {curve.reference}", caption)


def uncertainty(value: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return u(|H|)/|H| and u(arg H) in rad, (K,) each, of values (K,) with covariances (K, 2, 2)."""
    size = np.abs(value)
    along = np.stack([value.real, value.imag], axis=1) / size[:, None]
    across = np.stack([-value.imag, value.real], axis=1) / size[:, None]
    forms = [np.einsum("ki,kij,kj->k", axis, covariance, axis) for axis in (along, across)]
    return np.sqrt(np.maximum(forms[0], 0.0)) / size, np.sqrt(np.maximum(forms[1], 0.0)) / size


def _draw_magnitude(axes: Axes, curve: TransferCurve) -> None:
    """|H| on a logarithmic axis with its band, and the oscillators fitted."""
    size = np.abs(curve.value)
    relative, _ = uncertainty(curve.value, curve.covariance)
    low, high = size * np.maximum(1.0 - COVERAGE * relative, 1e-3), size * (1.0 + COVERAGE * relative)
    axes.fill_between(curve.frequency_hz, low, high, color=BLUE, alpha=0.25, linewidth=0, zorder=1)
    axes.plot(curve.frequency_hz, size, color=BLUE, linewidth=0.9, zorder=2)
    axes.set_yscale("log")
    for place, (_, band) in enumerate(curve.resonances):
        frequency = np.linspace(*band, 400)
        axes.plot(
            frequency,
            np.abs(_fitted(curve, place, frequency)),
            color=RED,
            linewidth=0.9,
            linestyle=(0, (4, 2)),
            zorder=2.5,
        )
    axes.set_ylim(0.7 * float(size.min()), 1.6 * float(size.max()))
    _few_decades(axes, size)
    unit = typeset(curve.unit)
    axes.set_ylabel("|H|" if unit == "1" else f"|H| / ({unit})")
    panel_label(axes, f"{curve.response} over {curve.reference}: magnitude")


def _fitted(curve: TransferCurve, place: int, frequency_hz: FloatArray) -> ComplexArray:
    """One oscillator with the rest of the modes outside the band, and all other oscillators."""
    own = curve.resonances[place][0].model(frequency_hz)
    others = [fit for number, (fit, _) in enumerate(curve.resonances) if number != place]
    for fit in others:
        own = own + replace(fit, residual=np.zeros(2, dtype=np.complex128)).model(frequency_hz)
    return own


def _draw_phase(axes: Axes, curve: TransferCurve) -> None:
    """Phase in degrees, wrapped, without strokes across the wrap."""
    phase = np.degrees(np.angle(curve.value))
    _, turn = uncertainty(curve.value, curve.covariance)
    band = COVERAGE * np.degrees(np.minimum(turn, np.pi / 2.0))
    broken = np.where(np.abs(np.diff(phase, prepend=phase[0])) > 180.0, np.nan, phase)
    axes.fill_between(curve.frequency_hz, broken - band, broken + band, color=BLUE, alpha=0.25, linewidth=0, zorder=1)
    axes.plot(curve.frequency_hz, broken, color=BLUE, linewidth=0.9, zorder=2)
    for fit, _ in curve.resonances:
        axes.axvline(fit.frequency_hz, color=RED, linewidth=0.7, linestyle=(0, (4, 2)), zorder=1.5)
    axes.set_ylim(-190.0, 190.0)
    axes.set_yticks([-180, -90, 0, 90, 180])
    axes.set_ylabel("phase / °")
    panel_label(axes, "phase")


def _draw_uncertainty(axes: Axes, curve: TransferCurve) -> None:
    """Relative expanded uncertainty of the magnitude, in all and of noise alone."""
    for covariance, colour, label in (
        (curve.covariance, BLACK, "all"),
        (curve.random_covariance, ORANGE, "noise alone"),
    ):
        relative, _ = uncertainty(curve.value, covariance)
        percent = np.minimum(100.0 * COVERAGE * relative, LARGEST_PERCENT)
        axes.plot(curve.frequency_hz, percent, color=colour, linewidth=0.8, label=label, zorder=2)
    axes.set_yscale("log")
    decades(axes.yaxis)
    low, high = axes.get_ylim()
    axes.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
    axes.set_ylabel("U(|H|) / %")
    axes.legend(loc="lower right", ncols=2, bbox_to_anchor=(1.0, 0.97), borderaxespad=0.0)
    panel_label(axes, "relative uncertainty of the magnitude")


def _draw_coherence(axes: Axes, curve: TransferCurve) -> None:
    """Coherence from its smallest value, at most 0.9, to one."""
    axes.plot(curve.frequency_hz, curve.coherence, color=GREY, linewidth=0.8, zorder=2)
    lowest = min(0.9, np.floor(10.0 * float(np.nanmin(curve.coherence))) / 10.0)
    axes.axhline(1.0, color=LIGHT, linewidth=0.7, zorder=1)
    axes.set_ylim(lowest, 1.0 + 0.06 * (1.0 - lowest))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.set_ylabel("γ²")
    panel_label(axes, "coherence")


def _frequency_axis(axes: Axes, frequency_hz: FloatArray) -> None:
    """Frequency, logarithmic for wide bands with plain numbers at 1, 2, 5."""
    axes.set_xlim(float(frequency_hz[0]), float(frequency_hz[-1]))
    if frequency_hz[-1] > WIDE_BAND * frequency_hz[0]:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("frequency / Hz")


def _few_decades(axes: Axes, size: FloatArray) -> None:
    """Powers of ten, or also their twos and fives where the curve spans less than two decades."""
    if size.max() > 100.0 * size.min():
        decades(axes.yaxis)
        return
    axes.yaxis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _plain(value: float) -> str:
    """A value of one digit as a plain number, or with a power of ten where it is far from one."""
    exponent = int(np.floor(np.log10(value) + 1e-9))
    return f"{value:g}" if abs(exponent) <= 3 else f"{value / 10.0**exponent:.0f}·{power_text(exponent)}"
