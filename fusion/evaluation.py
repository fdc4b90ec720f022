"""What one evaluated recording consists of: the tree handed to the result writers and the report."""

from __future__ import annotations

from dataclasses import dataclass, field

from fusion.fuse import Acceleration
from fusion.load import LoadResult
from fusion.manifest import Manifest
from fusion.measured_results import ChannelResult, ClockResult, StereoResult, TakeResult
from fusion.notices import AnyNotice
from fusion.outputs import Outputs
from fusion.point_spread import PointSpread
from fusion.propagated import MonteCarlo
from fusion.sensitivity import Sensitivity
from shaker.signals.frequencies import Lines


@dataclass(frozen=True)
class Evaluation:
    """Everything one recording yields.

    `accelerations`: one entry per body and source (`fused` first). `load`: wrench phasors at the sensor origin, N and
    N.m, with the manifest's sense. `outputs`: of the sensor. `points`: vibrometer points that look along one
    direction. `monte_carlo`: where it was asked for. `takes`: how they were tied, none where all was recorded at once.
    `settings`, `versions`, `input_hashes` (file -> SHA-256) say what was run on what.
    """

    manifest: Manifest
    lines: Lines
    clocks: tuple[ClockResult, ...]
    channels: tuple[ChannelResult, ...]
    stereo: tuple[StereoResult, ...]
    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None
    notices: tuple[AnyNotice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float = field(default=0.0)
    takes: tuple[TakeResult, ...] = ()
    points: tuple[PointSpread, ...] = ()
    monte_carlo: MonteCarlo | None = None
