"""Lines at one frequency: loads, outputs and unknowns, and the order of their elimination."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fusion.campaign.excited_line import LOADS, ExcitedLine
from fusion.estimation.uncertainty import Influence, Uncertainty, as_complex, real_stack
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

MOST_LOCAL = 256
"""Largest number of unknowns that are eliminated together for a group of lines (chosen for speed)."""
CHUNK = 512
"""Smallest number of lines whose readings are in memory at once (chosen for speed)."""


@dataclass(frozen=True)
class EliminationOrder:
    """Unknowns ordered by the lines on which they act.

    `single` (R, A): slots of unknowns of one line only; `wide` (W,): unknowns that are columns for all lines; `groups`:
    lines that share only wide unknowns with other groups, each with its unknowns.
    """

    single: BoolArray
    wide: IntArray
    groups: tuple[tuple[IntArray, IntArray], ...]

    def chunks(self) -> Iterator[tuple[tuple[IntArray, IntArray], ...]]:
        """Yield groups that together have at least `CHUNK` lines."""
        chunk: list[tuple[IntArray, IntArray]] = []
        drives = 0
        for group in self.groups:
            chunk.append(group)
            drives += len(group[0])
            if drives >= CHUNK:
                yield tuple(chunk)
                chunk, drives = [], 0
        if chunk:
            yield tuple(chunk)


def elimination_order(acting: IntArray, count: int) -> EliminationOrder:
    """Return the order for the unknowns `acting` (R, A) on each line (-1: none).

    `count`: number of unknowns.

    An unknown of more than half of the lines is wide; there are at most 2A of these. The others join lines to groups,
    beginning with those of fewest lines. They are wide if a group would have more than `MOST_LOCAL` unknowns.
    """
    rows, slots = np.nonzero(acting >= 0)
    names = acting[rows, slots]
    degree = np.bincount(names, minlength=count)
    by_name = np.argsort(names, kind="stable")
    ends = np.cumsum(degree)
    above, size = list(range(len(acting))), [0] * len(acting)

    def top(drive: int) -> int:
        while above[drive] != drive:
            above[drive] = drive = above[above[drive]]
        return drive

    wide, local = [], []
    for unknown in np.argsort(degree, kind="stable").tolist():
        if degree[unknown] < 2:
            continue
        acts_on = rows[by_name[ends[unknown] - degree[unknown] : ends[unknown]]].tolist()
        joined = {top(drive) for drive in acts_on} if 2 * degree[unknown] <= len(acting) else set()
        together = 1 + sum(size[drive] for drive in joined)
        if not joined or together > MOST_LOCAL:
            wide.append(unknown)
            continue
        first = min(joined)
        for drive in joined:
            above[drive] = first
        size[first] = together
        local.append((acts_on[0], unknown))
    groups: dict[int, tuple[list[int], list[int]]] = {}
    for drive in range(len(acting)):
        groups.setdefault(top(drive), ([], []))[0].append(drive)
    for drive, unknown in local:
        groups[top(drive)][1].append(unknown)
    pairs = tuple((np.array(drives), np.array(within, dtype=np.int64)) for drives, within in groups.values())
    return EliminationOrder((acting >= 0) & (degree[acting] == 1), np.array(sorted(wide), dtype=np.int64), pairs)


SLOPE = 1.0
"""Standard uncertainty of dln S/dln f, a bound for a sensor below a third of its resonance."""
SAME_LINE = 1e-7
"""Relative difference of frequencies without an effect on the sensitivity."""
LINE_SPACING = "lines apart"  # its name in files


@dataclass(frozen=True)
class Stack:
    """R lines at one frequency; loads in units of `load_size` (6,), outputs of `output_size` (C,).

    `load` (R, 6), `output` (R, C) with NaN if there is no reading; `load_noise`, `output_noise`: individual errors of
    each line; `unknowns` (E): those that lines share, or load and outputs share. Up to A of them act on one line:
    `acting` (R, A) lists them (-1: none), `load_effect` (R, A, 6) is their effect on the load for one standard
    uncertainty, `output_effect` (R, A, C) that on the outputs, relative to these.
    """

    drives: tuple[ExcitedLine, ...]
    channels: tuple[str, ...]
    load_size: FloatArray
    output_size: FloatArray
    load: ComplexArray
    output: ComplexArray
    load_noise: tuple[Uncertainty, ...]
    output_noise: tuple[Uncertainty, ...]
    unknowns: tuple[Influence, ...]
    acting: IntArray
    load_effect: ComplexArray
    output_effect: ComplexArray

    @property
    def frequency_hz(self) -> float:
        """Mean frequency of the lines."""
        return float(np.mean([drive.frequency_hz for drive in self.drives]))

    @property
    def usable(self) -> BoolArray:
        """Which outputs (R, C) have a reading."""
        return np.isfinite(self.output)

    @cached_property
    def individual_load_covariance(self) -> FloatArray:
        """Covariance (R, 12, 12) of every line's load without shared errors."""
        return np.concatenate([noise.covariance for noise in self.load_noise])

    @cached_property
    def individual_output_covariance(self) -> FloatArray:
        """Covariance (R, 2C, 2C) of every line's outputs without shared errors."""
        return np.concatenate([noise.covariance for noise in self.output_noise])

    def load_covariance(self) -> FloatArray:
        """Return the total covariance (R, 12, 12) of every line's load, including shared errors."""
        effect = real_stack(self.load_effect)
        return np.asarray(self.individual_load_covariance + effect.swapaxes(1, 2) @ effect)

    @cached_property
    def order(self) -> EliminationOrder:
        """Order in which unknowns are eliminated."""
        acts = np.any(self.load_effect != 0.0, axis=2) | np.any(self.output_effect != 0.0, axis=2)
        return elimination_order(np.where(acts, self.acting, -1), len(self.unknowns))


def stack_drives(drives: Sequence[ExcitedLine], channels: Sequence[str]) -> Stack:
    """Return lines as one stack with outputs in the order of `channels`.

    A channel that was not recorded has no reading. The unit of each load component and each output is its largest
    value.
    """
    if not drives:
        raise ValueError("drives: expected at least one, found none")
    names = tuple(channels)
    load = np.stack([drive.load for drive in drives])
    output = np.array([[drive.output(channel) for channel in names] for drive in drives], dtype=np.complex128)
    load_size, output_size = largest_magnitude(load), largest_magnitude(output)
    output = output / output_size
    sized = [
        (
            of_load.scaled(np.asarray((1.0 / load_size)[None], dtype=np.complex128)),
            _outputs_in_order(of_outputs, drive, names, output_size),
        )
        for drive, (of_load, of_outputs) in ((drive, drive.campaign_uncertainties()) for drive in drives)
    ]
    unknowns = {influence.name: influence for both in sized for part in both for influence in part.influences}
    index = {name: number for number, name in enumerate(unknowns)}
    unknown_names = [list(dict.fromkeys(i.name for part in both for i in part.influences)) for both in sized]
    most = max(map(len, unknown_names))
    acting = np.full((len(drives), most), -1)
    load_effect = np.zeros((len(drives), most, LOADS), np.complex128)
    output_effect = np.zeros((len(drives), most, len(names)), np.complex128)
    for row, (acting_names, (of_load, of_outputs)) in enumerate(zip(unknown_names, sized, strict=True)):
        slot = {name: number for number, name in enumerate(acting_names)}
        acting[row, : len(acting_names)] = [index[name] for name in acting_names]
        for influence in of_load.influences:
            load_effect[row, slot[influence.name]] = as_complex(influence.effect[0])
        # Relative to the output, zero if there is none.
        usable = np.isfinite(output[row]) & (output[row] != 0.0)
        for influence in of_outputs.influences:
            change, relative = as_complex(influence.effect[0]), np.zeros(len(names), np.complex128)
            output_effect[row, slot[influence.name]] = np.divide(change, output[row], out=relative, where=usable)
    stack = Stack(
        drives=tuple(drives),
        channels=names,
        load_size=load_size,
        output_size=output_size,
        load=load / load_size,
        output=output,
        load_noise=tuple(Uncertainty(of_load.random) for of_load, _ in sized),
        output_noise=tuple(Uncertainty(of_outputs.random) for _, of_outputs in sized),
        unknowns=tuple(unknowns.values()),
        acting=acting,
        load_effect=load_effect,
        output_effect=output_effect,
    )
    return _with_slopes(stack)


def largest_magnitude(values: ComplexArray) -> FloatArray:
    """Return the largest magnitude of each column, 1 if there is none."""
    largest = np.max(np.where(np.isfinite(values), np.abs(values), 0.0), axis=0)
    return np.where(largest > 0.0, largest, 1.0)


def _outputs_in_order(
    uncertainty: Uncertainty, drive: ExcitedLine, channels: tuple[str, ...], size: FloatArray
) -> Uncertainty:
    """Return the uncertainty of the outputs in the order of `channels`, in units of `size`."""
    have, want = len(drive.channels), len(channels)
    matrix = np.zeros((2 * want, 2 * have))
    for row, channel in enumerate(channels):
        if np.isfinite(drive.output(channel)):
            column = drive.channels.index(channel)
            matrix[row, column] = matrix[row + want, column + have] = 1.0 / size[row]
    return uncertainty.nan_as_zero().transformed(matrix[None])


def _with_slopes(stack: Stack) -> Stack:
    """Return the stack with the change of each channel's sensitivity with frequency as an unknown.

    The lines of one group may have slightly different frequencies. An output at f is that at the mean f₀ times 1 +
    s·ln(f/f₀); s has the standard uncertainty `SLOPE` in its real and imaginary part. Equal frequencies add no
    uncertainty.
    """
    log_ratio = np.log(np.array([drive.frequency_hz for drive in stack.drives]) / stack.frequency_hz)
    if np.ptp(log_ratio) <= SAME_LINE:
        return stack
    unknowns, drives = [], len(stack.drives)
    effects = np.zeros((drives, 2 * len(stack.channels), len(stack.channels)), np.complex128)
    for index, channel in enumerate(stack.channels):
        for number, (part, turn) in enumerate((("in phase", 1.0), ("out of phase", 1.0j))):
            effects[:, 2 * index + number, index] = SLOPE * turn * log_ratio
            name = f"change of {channel} with frequency at {stack.frequency_hz:.6g} Hz, {part}"
            unknowns.append(Influence(name, LINE_SPACING, SLOPE, "", np.zeros((1, 2)), "rig"))
    further = np.broadcast_to(len(stack.unknowns) + np.arange(len(unknowns)), effects.shape[:2])
    none = np.zeros((drives, len(unknowns), LOADS), np.complex128)
    return replace(
        stack,
        unknowns=(*stack.unknowns, *unknowns),
        acting=np.concatenate([stack.acting, further], axis=1),
        load_effect=np.concatenate([stack.load_effect, none], axis=1),
        output_effect=np.concatenate([stack.output_effect, effects], axis=1),
    )
