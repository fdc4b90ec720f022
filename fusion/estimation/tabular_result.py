"""Complex values over frequency as a table, a figure and one line of text."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.base import round_to_uncertainty
from fusion.estimation.coverage import Polar
from fusion.estimation.uncertainty import Uncertainty, polar_elements
from shaker.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure


@dataclass(frozen=True)
class PhasorRows:
    """Values (K, E) of E elements at K frequencies with their names.

    Attributes
    ----------
    name : name of the values, such as `sensitivity`.
    frequency_hz : (K,), Hz.
    value : (K, E), complex; NaN where there is no result.
    uncertainty : of all values, real parts first.
    channel, component, unit : (E,), names of the elements and their units.
    kind : (K,), `ratio`, `element` or `harmonic` of each line.
    """

    name: str
    frequency_hz: FloatArray
    value: ComplexArray
    uncertainty: Uncertainty
    channel: tuple[str, ...]
    component: tuple[str, ...]
    unit: tuple[str, ...]
    kind: tuple[str, ...]

    def results(self) -> Iterator[tuple[int, int, Polar]]:
        """Yield line, element and polar form of every value that is a result."""
        with np.errstate(over="ignore", invalid="ignore"):  # damaged files return their numbers as they are
            lines = polar_elements(self.value, self.uncertainty)
        for k, line in enumerate(lines):
            yield from ((k, e, polar) for e, polar in enumerate(line) if polar is not None)

    def main_elements(self) -> list[int]:
        """Return the elements whose output belongs to their load, or all where none does."""
        pairs = enumerate(zip(self.channel, self.component, strict=True))
        return [e for e, (channel, component) in pairs if channel == component] or list(range(len(self.unit)))


class TabularResult(ABC):
    """A result over frequency that can be shown: `table()`, `plot()` and `repr`.

    Examples
    --------
    >>> import shakercal
    >>> sensitivity = shakercal.evaluate("sample_images/demo/Fz-0080").sensitivity
    >>> sensitivity
    sensitivity: Fz/Fz = (7.0028 ± 0.0050)e-7 (V/V)/N at 80.0002 Hz (k = 1.98); 6 elements at 3 lines
    >>> sensitivity.table().columns[:4].tolist()
    ['frequency_hz', 'channel', 'component', 'magnitude']
    """

    @abstractmethod
    def phasor_rows(self) -> PhasorRows:
        """Return the values with their names, units and uncertainty."""

    def table(self) -> Any:
        """Return one row per value with the columns of `sensitivity.csv`.

        Returns
        -------
        A pandas `DataFrame`; where pandas is not installed, a list of dictionaries.
        """
        shown = self.phasor_rows()
        rows = [
            {
                "frequency_hz": float(shown.frequency_hz[k]),
                "channel": shown.channel[e],
                "component": shown.component[e],
                **asdict(polar),
                "unit": shown.unit[e],
                "kind": shown.kind[k],
            }
            for k, e, polar in shown.results()
        ]
        try:
            pandas: Any = import_module("pandas")
        except ImportError:
            return rows
        return pandas.DataFrame(rows)

    def plot(self) -> MatplotlibFigure:
        """Return a figure of magnitude and phase with U (95 %) as error bars.

        It shows the elements whose output belongs to their load, or all elements if none does.
        """
        from matplotlib.figure import Figure

        shown = self.phasor_rows()
        figure = Figure(figsize=(7.0, 5.0), layout="constrained")
        magnitude, phase = figure.subplots(2, 1, sharex=True)
        for element in shown.main_elements():
            found = [(shown.frequency_hz[k], polar) for k, e, polar in shown.results() if e == element]
            if not found:
                continue
            frequency, label = [f for f, _ in found], f"{shown.channel[element]}/{shown.component[element]}"
            style: Any = {"fmt": "o", "capsize": 3.0, "label": f"{label} in {shown.unit[element]}"}
            polars = [polar for _, polar in found]
            magnitude.errorbar(
                frequency, [p.magnitude for p in polars], [p.expanded_magnitude for p in polars], **style
            )
            phase.errorbar(frequency, [p.phase_rad for p in polars], [p.expanded_phase_rad for p in polars], **style)
        magnitude.set_ylabel(f"{shown.name}, magnitude")
        phase.set_ylabel("phase / rad")
        phase.set_xlabel("frequency / Hz")
        magnitude.legend(title="U: 95 %")
        return figure

    def __repr__(self) -> str:
        shown = self.phasor_rows()
        size = f"{len(shown.unit)} elements at {len(shown.frequency_hz)} lines"
        mains = shown.main_elements()
        first = next(((k, e, polar) for k, e, polar in shown.results() if e in mains), None)
        if first is None:
            return f"{shown.name}: no result; {size}"
        k, e, polar = first
        text = round_to_uncertainty(polar.magnitude, polar.expanded_magnitude).text
        element = f"{shown.channel[e]}/{shown.component[e]} = {text} {shown.unit[e]}"
        return f"{shown.name}: {element} at {shown.frequency_hz[k]:.6g} Hz (k = {polar.k:.3g}); {size}"
