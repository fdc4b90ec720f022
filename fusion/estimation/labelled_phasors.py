"""Labelled complex values over frequency: as a table, a figure and one line of text."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.estimation.coverage import Polar
from fusion.estimation.uncertainty import Uncertainty, polar_elements
from shakercal._common.arrays import ComplexArray, FloatArray, check_shape
from shakercal._common.digits import quantity_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure


class TabularResult(ABC):
    """A result over frequency that is shown by `table()`, `plot()` and `repr`.

    Examples
    --------
    >>> import shakercal
    >>> sensitivity = shakercal.evaluate("sample_images/demo/Fz-0080").element  # doctest: +SKIP
    >>> sensitivity  # doctest: +SKIP
    element: Fz/Fz = (7.0032 ± 0.0051) × 10⁻⁷ (V/V)/N at 80.0002 Hz (k = 1.97); 6 elements at 1 line
    >>> sensitivity.plot().savefig("element.png")  # doctest: +SKIP
    """

    @abstractmethod
    def labelled(self) -> LabelledPhasors:
        """Return the values with their names, units and uncertainty."""

    def table(self) -> Any:
        """Return one row per result with the columns of `sensitivity.csv`.

        Returns
        -------
        A pandas `DataFrame`; without pandas a list of dictionaries.
        """
        rows = self.labelled().rows()
        try:
            return importlib.import_module("pandas").DataFrame(rows)
        except ImportError:
            return rows

    def plot(self) -> MatplotlibFigure:
        """Return a figure of magnitude and phase over frequency with U.

        Shown are elements whose output belongs to their load, or all elements of the unit of the first one.
        """
        from matplotlib.figure import Figure

        shown = self.labelled()
        figure = Figure(figsize=(7.0, 5.0), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        elements = shown.main_elements()
        for element in elements:
            if shown.unit[element] != shown.unit[elements[0]]:
                continue
            found = [(shown.frequency_hz[k], polar) for k, e, polar in shown.results if e == element]
            style: Any = {"fmt": "o", "capsize": 3.0, "label": shown.elements[element]}
            frequency = [hz for hz, _ in found]
            panels[0].errorbar(
                frequency, [p.magnitude for _, p in found], [p.expanded_magnitude for _, p in found], **style
            )
            panels[1].errorbar(
                frequency, [p.phase_rad for _, p in found], [p.expanded_phase_rad for _, p in found], **style
            )
        panels[0].set_ylabel(f"magnitude in {shown.unit[elements[0]]}" if elements else "magnitude")
        panels[1].set_ylabel("phase / rad")
        panels[1].set_xlabel("frequency / Hz")
        panels[0].set_title(f"{shown.name}, U for a coverage of 95 %")
        panels[0].legend()
        return figure

    def __repr__(self) -> str:
        shown = self.labelled()
        counts = [(len(shown.unit), "element"), (len(shown.frequency_hz), "line")]
        size = " at ".join(f"{count} {word}{'s' * (count != 1)}" for count, word in counts)
        mains = shown.main_elements()
        found = [one for one in shown.results if one[1] in mains]
        if not found:
            return f"{shown.name}: no result; {size}"
        k, e, polar = max(found, key=lambda one: (-one[0], one[2].magnitude / max(one[2].expanded_magnitude, 1e-300)))
        text = quantity_text(polar.magnitude, polar.expanded_magnitude, shown.unit[e])
        headline = f"{shown.elements[e]} = {text} at {shown.frequency_hz[k]:.6g} Hz"
        return f"{shown.name}: {headline} (k = {polar.k:.3g}); {size}"


@dataclass(frozen=True, repr=False)
class LabelledPhasors(TabularResult):
    """Complex values of E elements at K frequencies with names, units and uncertainty.

    Attributes
    ----------
    name : name of the quantity.
    frequency_hz : (K,) frequencies in Hz.
    value : (K, E) peak phasors or ratios of them; NaN if there is no result.
    channel : (E) channel of the sensor; for an acceleration or load its body.
    component : (E) component of the load or motion.
    unit : (E) unit of each element.
    uncertainty : uncertainty of all elements by named unknowns, real parts first.
    kind : (K) kind of each line.
    """

    name: str
    frequency_hz: FloatArray
    value: ComplexArray
    channel: tuple[str, ...]
    component: tuple[str, ...]
    unit: tuple[str, ...]
    uncertainty: Uncertainty
    kind: tuple[str, ...]

    def __post_init__(self) -> None:
        lines, size = len(self.frequency_hz), len(self.unit)
        check_shape("frequency_hz", self.frequency_hz, (lines,))
        check_shape("value", self.value, (lines, size))
        check_shape("covariance", self.uncertainty.random[0].covariance, (lines, 2 * size, 2 * size))
        if len(self.kind) != lines:
            raise ValueError(f"kind: expected one of each of {lines} lines, found {len(self.kind)}")

    @property
    def covariance(self) -> FloatArray:
        """Covariance (K, 2E, 2E) of [all Re, all Im] at each frequency."""
        return self.uncertainty.covariance

    @property
    def elements(self) -> tuple[str, ...]:
        """Name of each element, `channel/component`."""
        return tuple(f"{channel}/{component}" for channel, component in zip(self.channel, self.component, strict=True))

    def of(self, channel: str, component: str) -> ComplexArray:
        """Return the values (K,) of one element."""
        if (name := f"{channel}/{component}") not in self.elements:
            raise ValueError(f"channel, component: expected one of {', '.join(self.elements)}, found {name}")
        return np.asarray(self.value[:, self.elements.index(name)])

    @cached_property
    def results(self) -> tuple[tuple[int, int, Polar], ...]:
        """Line, element and polar form of every value that is a result."""
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of damaged files are returned unchanged
            lines = polar_elements(self.value, self.uncertainty)
        return tuple((k, e, one) for k, line in enumerate(lines) for e, one in enumerate(line) if one is not None)

    def labelled(self) -> LabelledPhasors:
        """Return these values."""
        return self

    def main_elements(self) -> list[int]:
        """Return the elements with results whose output belongs to their load, or all with results."""
        present = sorted({e for _, e, _ in self.results})
        return [e for e in present if self.channel[e] == self.component[e]] or present

    def to_dataframe(self) -> Any:
        """Return a pandas table with one row per result and the columns of `sensitivity.csv`."""
        return _optional("pandas").DataFrame(self.rows())

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per result with the columns of `sensitivity.csv`."""
        rows = []
        for k, e, polar in self.results:
            named = {"channel": self.channel[e], "component": self.component[e]}
            units = {"unit": self.unit[e], "kind": self.kind[k]}
            rows.append({"frequency_hz": float(self.frequency_hz[k]), **named, **asdict(polar), **units})
        return rows

    def to_xarray(self) -> Any:
        """Return an xarray `Dataset` of `value` and `covariance` over `frequency_hz` and `element`."""
        parts = [f"{part} {element}" for part in ("Re", "Im") for element in self.elements]
        labels = {name: ("element", list(getattr(self, name))) for name in ("channel", "component", "unit")}
        units = set(self.unit)
        attributes = {"long_name": self.name, **({"units": self.unit[0]} if len(units) == 1 else {})}
        return _optional("xarray").Dataset(
            {
                "value": (("frequency_hz", "element"), self.value, attributes),
                "covariance": (
                    ("frequency_hz", "row", "column"),
                    self.covariance,
                    {"long_name": "of [all Re, all Im]"},
                ),
            },
            coords={
                "frequency_hz": ("frequency_hz", self.frequency_hz, {"units": "Hz"}),
                "element": list(self.elements),
                "row": parts,
                "column": parts,
                "kind": ("frequency_hz", list(self.kind)),
                **labels,
            },
        )


def _optional(name: str) -> Any:
    """Import an optional package."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f"{name} is not installed: pip install {name}") from None
