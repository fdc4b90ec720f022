"""Export of results and recordings as universal files (UFF, `shakercal export`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion.base import PROGRAM, __version__, check_new_file
from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import RECORDING_NAME, load_manifest
from fusion.recording.transducer import TRANSDUCERS
from fusion.report.atomic_files import write_atomically
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.labelled_results import CAMPAIGN_FILE, read_results
from fusion.report.report_notices import NO_RESULTS, NO_SENSITIVITY_TO_EXPORT
from shaker.io.universal import UniversalFunction, UniversalShape
from shaker.io.universal_write import universal_function, universal_nodes, universal_shape, universal_units
from shaker.labels import AXES, LOAD_COMPONENTS, MOTION_COMPONENTS, load_unit
from shakercal._common.arrays import FloatArray

TRANSFER_FILE, ELEMENT_FILE = "transfer.h5", "elastomer.h5"
ORIGIN = 1  # node of the sensor origin; outputs, channels and bodies are nodes behind it
DIRECTIONS = dict(zip((*LOAD_COMPONENTS, *MOTION_COMPONENTS), 2 * ("+X", "+Y", "+Z", "+RX", "+RY", "+RZ"), strict=True))
ALONG = 1e-9
"""Largest deviation of a direction's component from 1 along an axis, for rounding."""


class UniversalExport(NamedTuple):
    """Content of a universal file: functions, nodes with positions, shapes."""

    functions: list[UniversalFunction]
    nodes: dict[int, FloatArray]
    shapes: list[UniversalShape]


def export_universal(path: Path, output: Path, *, text: bool = False, force: bool = False) -> UniversalExport:
    """Write results or a recording as a universal file and return its content.

    `text`: functions as data set 58 instead of 58b.
    """
    check_new_file(output, force=force)
    made = _exported(path)
    parts = [universal_units()]
    if made.nodes:
        parts.append(universal_nodes(np.array(list(made.nodes)), np.array(list(made.nodes.values()))))
    parts += [universal_shape(shape, number) for number, shape in enumerate(made.shapes, 1)]
    parts += [universal_function(function, binary=not text) for function in made.functions]
    write_atomically(output, b"".join(parts))
    return made


def _exported(path: Path) -> UniversalExport:
    """Return the content for a path."""
    readers = {
        CAMPAIGN_FILE: _of_results,
        RESULT_FILE: _of_results,
        TRANSFER_FILE: _of_transfer,
        ELEMENT_FILE: _of_element,
        RECORDING_NAME: _of_recording,
    }
    for name, read in readers.items():
        file = path if path.is_file() and path.name == name else path / name
        if file.is_file():
            return read(file)
    raise InputError(NO_RESULTS, path, expected=" or ".join(readers))


PHASORS = "x(t) = Re{X exp(+j omega t)}, peak values, SI"


def _titles(name: str, what: str, how: str = PHASORS) -> tuple[str, ...]:
    return what, name, "NONE", how, f"{PROGRAM} {__version__}"


def _of_results(file: Path) -> UniversalExport:
    """Return sensitivities over frequency.

    Each output is a response node, the load the reference at the origin.
    """
    results = read_results(file)
    every = [*([results.sensitivity] if results.sensitivity else []), *([results.element] if results.element else [])]
    every += results.curve
    outputs = list(dict.fromkeys(channel for found in every for channel in found.channel))
    functions = [function for found in every for function in _of_phasors(results.name, found, outputs)]
    if not functions:
        raise InputError(NO_SENSITIVITY_TO_EXPORT, file)
    nodes = {ORIGIN + number: np.zeros(3) for number in range(len(outputs) + 1)}
    return UniversalExport(functions, nodes, [])


def _of_phasors(name: str, found: LabelledPhasors, outputs: Sequence[str]) -> Iterator[UniversalFunction]:
    """Yield one function for each element, without lines that have no result."""
    for e, (channel, component) in enumerate(zip(found.channel, found.component, strict=True)):
        finite = np.isfinite(found.value[:, e])
        if finite.any():
            output_unit = found.unit[e].rpartition("/")[0].removeprefix("(").removesuffix(")")
            yield UniversalFunction(
                name=f"{channel}/{component}",
                kind="frequency response",
                abscissa=found.frequency_hz[finite],
                value=found.value[finite, e],
                abscissa_unit="Hz",
                unit=f"({output_unit})/({load_unit(component)})",
                response=f"{ORIGIN + 1 + outputs.index(channel)}",
                reference=f"{ORIGIN}{DIRECTIONS[component]}",
                titles=_titles(name, f"{found.name}: output {channel} over load {component}"),
            )


def _of_transfer(file: Path) -> UniversalExport:
    """Return transfer functions: each channel is a response node, the previous node its reference."""
    functions: list[UniversalFunction] = []
    with open_results(file) as content:
        name = str(content.attrs["recording"])
        for group in content["references"].values():
            ratio, reference = group["transfer/ratio"], str(group["transfer"].attrs["reference"])
            first = ORIGIN + len(functions)
            channels, units = (ratio[key].asstr()[()].tolist() for key in ("channels", "unit"))
            for number, (channel, unit) in enumerate(zip(channels, units, strict=True)):
                finite = np.isfinite(ratio["value"][:, number])
                functions.append(
                    UniversalFunction(
                        name=channel,
                        kind="transmissibility" if unit == "1" else "frequency response",
                        abscissa=ratio["frequency_hz"][()][finite],
                        value=ratio["value"][()][finite, number],
                        abscissa_unit="Hz",
                        unit=unit,
                        response=f"{first + 1 + number}",
                        reference=f"{first}",
                        titles=_titles(name, f"{channel} over {reference}"),
                    )
                )
    return UniversalExport(functions, {}, [])


def _of_element(file: Path) -> UniversalExport:
    """Return nodes of the frame of an elastic element, and its natural modes."""
    with open_results(file) as content:
        frame, name = content["frame"], str(content.attrs["name"])
        node_m, motion = frame["node_m"][()], frame["node_motion"][()]
        frequency = frame["modes/frequency_hz"][()]
    node = np.arange(1, len(node_m) + 1)
    shapes = [
        UniversalShape(
            node=node,
            value=motion[:, mode].reshape(len(node), 6).astype(complex),
            analysis="normal mode",
            quantity="displacement",
            frequency_hz=float(frequency[mode]),
            damping_ratio=np.nan,
            time_s=np.nan,
            titles=(f"mode {mode + 1}: {frequency[mode]:.6g} Hz", name, "NONE", "NONE", f"{PROGRAM} {__version__}"),
        )
        for mode in range(len(frequency))
    ]
    return UniversalExport([], dict(zip(node.tolist(), node_m, strict=True)), shapes)


def _of_recording(file: Path) -> UniversalExport:
    """Return the records of all channels in SI, at the positions of instruments."""
    manifest = load_manifest(file.parent)
    functions: list[UniversalFunction] = []
    nodes: dict[int, FloatArray] = {}
    for record in read_daqs(manifest):
        for channel in record.entry.channel:
            node = ORIGIN + len(functions)
            direction = ""
            if channel.point is not None:
                nodes[node] = np.array(channel.point, dtype=np.float64)
            if channel.direction is not None:
                direction = _along(channel.direction)
            unit = _unit(manifest, channel)
            functions.append(
                UniversalFunction(
                    name=channel.name,
                    kind="time response",
                    abscissa=record.time_s(channel.name),
                    value=record.values(channel),
                    abscissa_unit="s",
                    unit=unit,
                    response=f"{node}{direction}",
                    reference="0",
                    titles=_titles(manifest.name, f"{record.entry.name}: {channel.name}, {channel.quantity}", "SI"),
                )
            )
    return UniversalExport(functions, nodes, [])


def _along(direction: Sequence[float]) -> str:
    """Return the axis of a direction, empty if it is not along one."""
    unit = np.asarray(direction, dtype=np.float64)
    unit = unit / np.linalg.norm(unit)
    axis = int(np.argmax(np.abs(unit)))
    if abs(unit[axis]) < 1.0 - ALONG:
        return ""
    return f"{'+' if unit[axis] > 0.0 else '-'}{AXES[axis].upper()}"


def _unit(manifest: Any, channel: Any) -> str:
    """Return the SI unit of a channel's samples times its scale."""
    if channel.quantity in TRANSDUCERS:
        return TRANSDUCERS[channel.quantity].unit
    if channel.quantity in ("force", "voltage"):
        return "N" if channel.quantity == "force" else "V"
    if channel.quantity == "output" and manifest.rig.sensor is not None:
        return str(manifest.rig.sensor.unit)
    return ""
