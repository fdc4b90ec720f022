"""One recording of a simulated campaign: what is driven, how, and what its manifest says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion.simulate.mechanics import ComplexArray, Motion, TruePart, wrench
from fusion.simulate.preset import ChannelSpec, DaqSpec, PartSpec, Preset, accelerometer

LEAD_S = 0.1  # of the first frame after the first recorder's start, and of a record's end after the last frame
BRIDGE_START_S = 0.0437


@dataclass(frozen=True)
class Run:
    """One recording: its `preset` (with the whole load), its `mounting`, the name and first lines of its manifest.

    `rig_file`, `rig`: the file of the rig that it stands on, and the set-up written there. `parts`: those of the load
    that this recording's own manifest states. `direction`: 3 or 6 numbers; `driven`: the place of the component that
    is driven.
    """

    name: str
    preset: Preset
    rig: Preset
    rig_file: str
    mounting: str
    kind: str
    direction: tuple[float, ...]
    driven: int
    nominal_hz: tuple[float, ...]
    parts: tuple[PartSpec, ...] = ()


def timed(preset: Preset, camera_rate_hz: float) -> Preset:
    """Return the preset with a camera rate, and records of its one or two recorders that hold all frames."""
    end = LEAD_S + preset.frames / camera_rate_hz + LEAD_S
    starts = (0.0, BRIDGE_START_S)
    daqs: tuple[DaqSpec, ...] = tuple(
        replace(daq, start_s=start, duration_s=end - start) for daq, start in zip(preset.daqs, starts, strict=False)
    )
    return replace(preset, camera_rate_hz=camera_rate_hz, first_frame_s=LEAD_S, daqs=daqs)


def triaxial(point: tuple[float, float, float]) -> tuple[ChannelSpec, ...]:
    """Return the three channels of an accelerometer on the load, each axis calibrated on its own."""
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    return tuple(accelerometer(f"acceleration_{name}", "load", point, axis) for name, axis in axes.items())


def wrench_direction(parts: tuple[PartSpec, ...], translation: tuple[float, float, float]) -> tuple[float, ...]:
    """Return the six load components that a unit acceleration of rigid parts needs, as they are stated: N and N·m."""
    amplitude = np.array([[*translation, 0.0, 0.0, 0.0]], dtype=np.complex128)
    rigid = [TruePart(p.mass, np.array(p.centre_of_mass), np.diag(p.inertia)) for p in parts]
    total = wrench(Motion(np.array([1.0]), amplitude), rigid, np.zeros(3))[0].real
    return tuple(round(float(component), 4) + 0.0 for component in total)


def as_phasors(values: ComplexArray) -> tuple[tuple[complex, ...], ...]:
    """Return phasors (K, 6) in the form of a preset."""
    return tuple(tuple(complex(v) for v in row) for row in values)
