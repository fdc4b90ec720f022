"""Loads and outputs of several drives in units of their own size, with everything that makes them uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.drive import LOADS, Drive
from fusion.uncertainty import Influence, Uncertainty
from shaker._checks import BoolArray, ComplexArray, FloatArray

SLOPE = 1.0
"""Standard uncertainty of dln S/dln f: what is not known of a sensor below a third of its resonance."""
SAME_LINE = 1e-7
"""Relative difference of frequencies that changes no sensitivity."""
LINES_APART = "lines apart"


@dataclass(frozen=True)
class Stack:
    """R drives at one frequency, loads in units of `load_size` (6,), outputs of `output_size` (C,).

    `load` (R, 6), `output` (R, C) with NaN where there is no reading; `load_noise`, `output_noise`: what is each
    drive's own, by drive; `unknowns` (E): what drives share or load and outputs share, with its change of the loads for
    one standard uncertainty `load_effect` (E, R, 6), and of the outputs relative to them `output_effect` (E, R, C).
    """

    drives: tuple[Drive, ...]
    channels: tuple[str, ...]
    load_size: FloatArray
    output_size: FloatArray
    load: ComplexArray
    output: ComplexArray
    load_noise: tuple[Uncertainty, ...]
    output_noise: tuple[Uncertainty, ...]
    unknowns: tuple[Influence, ...]
    load_effect: ComplexArray
    output_effect: ComplexArray

    @property
    def frequency_hz(self) -> float:
        """Return the mean frequency of the drives."""
        return float(np.mean([drive.frequency_hz for drive in self.drives]))

    @property
    def usable(self) -> BoolArray:
        """Return which outputs (R, C) have a reading."""
        return np.isfinite(self.output)

    def load_covariance(self) -> FloatArray:
        """Return the whole covariance (R, 12, 12) of every drive's load, common errors included."""
        effect = np.concatenate([self.load_effect.real, self.load_effect.imag], axis=2)
        own = np.concatenate([noise.covariance for noise in self.load_noise])
        return np.asarray(own + np.einsum("eri,erj->rij", effect, effect))


def stack_drives(drives: Sequence[Drive], channels: Sequence[str]) -> Stack:
    """Return drives as one stack, their outputs in the order of `channels`; a channel not recorded has no reading.

    Each component of the load is measured in its largest among the drives, each output likewise.
    """
    if not drives:
        raise ValueError("drives: expected at least one, found none")
    wanted = tuple(channels)
    load = np.stack([drive.load for drive in drives])
    output = np.stack([_in_order(drive, wanted) for drive in drives])
    load_size, output_size = _size(load), _size(output)
    parts = [drive.shared() for drive in drives]
    sized = [
        (
            of_load.scaled(np.asarray((1.0 / load_size)[None], dtype=np.complex128)),
            _outputs_in_order(of_outputs, drive, wanted, output_size),
        )
        for drive, (of_load, of_outputs) in zip(drives, parts, strict=True)
    ]
    known = {influence.name: influence for both in sized for part in both for influence in part.influences}
    load_effect = np.zeros((len(known), len(drives), LOADS), np.complex128)
    output_effect = np.zeros((len(known), len(drives), len(wanted)), np.complex128)
    place = {name: number for number, name in enumerate(known)}
    output = output / output_size
    for row, (of_load, of_outputs) in enumerate(sized):
        for influence in of_load.influences:
            load_effect[place[influence.name], row] = _as_complex(influence.effect[0])
        for influence in of_outputs.influences:
            change = _as_complex(influence.effect[0])
            output_effect[place[influence.name], row] = _quotient(change, output[row])
    stack = Stack(
        drives=tuple(drives),
        channels=wanted,
        load_size=load_size,
        output_size=output_size,
        load=load / load_size,
        output=output,
        load_noise=tuple(Uncertainty(of_load.random) for of_load, _ in sized),
        output_noise=tuple(Uncertainty(of_outputs.random) for _, of_outputs in sized),
        unknowns=tuple(known.values()),
        load_effect=load_effect,
        output_effect=output_effect,
    )
    return _with_slopes(stack)


def _size(values: ComplexArray) -> FloatArray:
    """Largest magnitude of each column, 1 where there is none."""
    largest = np.max(np.where(np.isfinite(values), np.abs(values), 0.0), axis=0)
    return np.where(largest > 0.0, largest, 1.0)


def _in_order(drive: Drive, channels: tuple[str, ...]) -> ComplexArray:
    """Outputs of a drive by the names wanted, NaN where it has none."""
    empty = complex(np.nan, np.nan)
    return np.array([drive.outputs[drive.channels.index(c)] if c in drive.channels else empty for c in channels])


def _outputs_in_order(
    uncertainty: Uncertainty, drive: Drive, channels: tuple[str, ...], size: FloatArray
) -> Uncertainty:
    """Uncertainty of the outputs by the names wanted, in units of their size; zero where there is no reading."""
    have, want = len(drive.channels), len(channels)
    matrix = np.zeros((2 * want, 2 * have))
    for row, channel in enumerate(channels):
        if channel in drive.channels and np.isfinite(drive.outputs[drive.channels.index(channel)]):
            column = drive.channels.index(channel)
            matrix[row, column] = matrix[row + want, column + have] = 1.0 / size[row]
    known = Uncertainty(
        tuple(replace(part, covariance=np.nan_to_num(part.covariance)) for part in uncertainty.random),
        tuple(replace(influence, effect=np.nan_to_num(influence.effect)) for influence in uncertainty.influences),
    )
    return known.transformed(matrix[None])


def _as_complex(stacked: FloatArray) -> ComplexArray:
    """Complex values of [Re, Im]."""
    half = len(stacked) // 2
    return np.asarray(stacked[:half] + 1j * stacked[half:])


def _quotient(numerator: ComplexArray, denominator: ComplexArray) -> ComplexArray:
    """Complex quotient, zero where there is no denominator."""
    usable = np.isfinite(denominator) & (denominator != 0.0)
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=usable)


def _with_slopes(stack: Stack) -> Stack:
    """Stack with one complex unknown per channel more: how its sensitivity changes over lines that lie side by side.

    An output at f is that at the mean f₀ times 1 + s·ln(f/f₀); s has the standard uncertainty `SLOPE` in real and in
    imaginary part, so that lines apart cost what they must, and lines of one frequency nothing.
    """
    frequency = np.array([drive.frequency_hz for drive in stack.drives])
    away = np.log(frequency / stack.frequency_hz)
    if np.ptp(away) <= SAME_LINE:
        return stack
    unknowns, effects = list(stack.unknowns), [stack.output_effect]
    for place, channel in enumerate(stack.channels):
        for part, turn in (("in phase", 1.0), ("out of phase", 1.0j)):
            effect = np.zeros((1, *stack.output.shape), np.complex128)
            effect[0, :, place] = SLOPE * turn * away
            effects.append(effect)
            name = f"change of {channel} with frequency at {stack.frequency_hz:.6g} Hz, {part}"
            unknowns.append(Influence(name, LINES_APART, SLOPE, "", np.zeros((1, 2)), "rig"))
    more = len(unknowns) - len(stack.unknowns)
    none = np.zeros((more, *stack.load.shape), np.complex128)
    return replace(
        stack,
        unknowns=tuple(unknowns),
        load_effect=np.concatenate([stack.load_effect, none]),
        output_effect=np.concatenate(effects),
    )
