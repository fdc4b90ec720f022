"""Figure of a transfer function: magnitude, phase, uncertainty and coherence over frequency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator

from fusion.base import K2, typeset
from fusion.report.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    Picture,
    decades,
    draw_response,
    frequency_axis,
    panel_label,
    plain_logarithm,
    power_text,
    sheet,
)
from fusion.sensor.transfer.records import ReferenceResult
from shaker.arrays import ComplexArray, FloatArray
from shaker.identification.oscillator import Resonance

RASTER_ABOVE = 6000  # lines from which curves are drawn as an image
LARGEST_PERCENT = 100.0
DASHED = (0, (4, 2))


def draw_transfer(result: ReferenceResult, channel: int) -> Picture:
    """Magnitude and phase of one response with U (k = 2), relative uncertainty with its random part, and coherence."""
    response, coherence = result.transfer.ratio.channels[channel], result.transfer.coherence[:, channel]
    curve, both = result.transfer.ratio.select([response]), [channel, channel + len(result.transfer.ratio.channels)]
    frequency, value, unit = curve.frequency_hz, curve.value[:, 0], typeset(curve.unit[0])
    noise = result.random_covariance[:, both][:, :, both]
    fits = [(resonance.fit, resonance.band_hz) for resonance in result.resonances if resonance.response == response]
    title, size = f"{response} over {result.name}", np.abs(value)
    with sheet(f"transfer-{response}-{result.name}", 7.4, 4, heights=(2.3, 1.5, 1.2, 0.9)) as drawn:
        magnitude, phase, relative, linear = drawn.panels
        draw_response(magnitude, phase, frequency, value, uncertainty(value, curve.covariance), color=BLUE)
        for place, (fit, band) in enumerate(fits):
            inside = np.linspace(*band, 400)
            fitted = np.abs(_fitted([other for other, _ in fits], place, inside))
            magnitude.plot(inside, fitted, color=RED, linewidth=0.9, linestyle=DASHED, zorder=2.5)
            phase.axvline(fit.frequency_hz, color=RED, linewidth=0.7, linestyle=DASHED, zorder=1.5)
        magnitude.set_ylim(0.7 * float(size.min()), 1.6 * float(size.max()))
        if size.max() > 100.0 * size.min():
            decades(magnitude.yaxis)
        else:
            plain_logarithm(magnitude.yaxis)
            magnitude.yaxis.set_major_formatter(FuncFormatter(lambda number, _: _plain(number)))
        magnitude.set_ylabel("|H|" if unit == "1" else f"|H| / ({unit})")
        for covariance, colour, label in ((curve.covariance, BLACK, "all"), (noise, ORANGE, "noise alone")):
            percent = np.minimum(100.0 * K2 * uncertainty(value, covariance)[0], LARGEST_PERCENT)
            relative.plot(frequency, percent, color=colour, linewidth=0.8, label=label, zorder=2)
        relative.set_yscale("log")
        decades(relative.yaxis)
        low, high = relative.get_ylim()
        relative.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
        relative.set_ylabel("U(|H|) / %")
        relative.legend(loc="lower right", ncols=2, bbox_to_anchor=(1.0, 0.97), borderaxespad=0.0)
        linear.plot(frequency, coherence, color=GREY, linewidth=0.8, zorder=2)
        lowest = min(0.9, np.floor(10.0 * float(np.nanmin(coherence))) / 10.0)
        linear.axhline(1.0, color=LIGHT, linewidth=0.7, zorder=1)
        linear.set_ylim(lowest, 1.0 + 0.06 * (1.0 - lowest))
        linear.yaxis.set_major_locator(MaxNLocator(3))
        linear.set_ylabel("γ²")
        labels = (f"{title}: magnitude", "phase", "relative uncertainty of the magnitude", "coherence")
        for axes, text in zip(drawn.panels, labels, strict=True):
            axes.set_rasterization_zorder(3 if len(value) > RASTER_ABOVE else -1)
            panel_label(axes, text)
        frequency_axis(linear, frequency)
        told = " Red: the oscillators fitted, over the lines that were used." if fits else ""
        caption = (
            f"Bands: expanded uncertainty U (k = 2), which the third panel shows by itself.{told} A coherence below "
            "one tells of noise, of other sources or of a structure that is not linear."
        )
        return drawn.picture(title, caption, gap=(0.5, 0.3))


def uncertainty(value: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return u(|H|)/|H| and u(arg H) in rad, (K,) each, of values (K,) with covariances (K, 2, 2)."""
    size = np.abs(value)
    along = np.stack([value.real, value.imag], axis=1) / size[:, None]
    across = np.stack([-value.imag, value.real], axis=1) / size[:, None]
    forms = [np.einsum("ki,kij,kj->k", axis, covariance, axis) for axis in (along, across)]
    return np.sqrt(np.maximum(forms[0], 0.0)) / size, np.sqrt(np.maximum(forms[1], 0.0)) / size


def _fitted(fits: list[Resonance], place: int, frequency_hz: FloatArray) -> ComplexArray:
    """One oscillator with the rest of the modes outside the band, and all other oscillators."""
    value = fits[place].model(frequency_hz)
    for other in (*fits[:place], *fits[place + 1 :]):
        value = value + replace(other, residual=np.zeros(2, dtype=np.complex128)).model(frequency_hz)
    return value


def _plain(value: float) -> str:
    """A value of one digit as a plain number, or with a power of ten where it is far from one."""
    exponent = int(np.floor(np.log10(value) + 1e-9))
    return f"{value:g}" if abs(exponent) <= 3 else f"{value / 10.0**exponent:.0f}·{power_text(exponent)}"
