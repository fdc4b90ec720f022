"""Order in which shared unknowns are eliminated; time and memory grow linearly with the recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import BoolArray, IntArray

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
