"""Computation of the frozen inputs of `references.json`, quantity by quantity."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.base import round_to_uncertainty
from shakercal._common.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from lxml import etree

    from fusion.estimation.coverage import Polar

Inputs = Mapping[str, Any]


def sines(inputs: Inputs) -> dict[str, float]:
    """Compute the sine approximation of irregular samples below the Nyquist rate, differentiated."""
    from shaker.sine.sine_fit import fit_sines

    samples = np.array(inputs["samples_m"])[:, None]
    fit = fit_sines(np.array(inputs["time_s"]), samples, np.array(inputs["frequency_hz"]), ["z"], ["m"])
    moved = fit.phasors.differentiated(2, ["m/s^2"])
    found = {"offset": float(fit.offset[0]), "u_re 80 Hz": float(fit.phasors.u_re[0, 0])}
    for k, frequency in enumerate(inputs["frequency_hz"]):
        value = complex(fit.phasors.value[k, 0])
        found |= {f"re {frequency:g} Hz": value.real, f"im {frequency:g} Hz": value.imag}
        found[f"acceleration {frequency:g} Hz"] = float(abs(moved.value[k, 0]))
    return found


def trigger(inputs: Inputs) -> dict[str, float]:
    """Compute the edges of a camera's trigger and their periodic model."""
    from shaker.timebase.edges import find_edges
    from shaker.timebase.trigger import fit_trigger

    samples = np.frombuffer(zlib.decompress(base64.b64decode(inputs["samples"])), dtype=np.uint8).astype(float)
    fit = fit_trigger(find_edges(samples, inputs["sample_rate_hz"]))
    return {"edges": float(fit.edges), "start": fit.start_s, "period": fit.period_s}


def frames(inputs: Inputs) -> dict[str, float]:
    """Compute the displacements of subsets between two frames."""
    from photogram.bspline import spline_of_image
    from photogram.subsets.find import identity_registration
    from photogram.subsets.icgn import TrackSettings, register
    from photogram.subsets.reference import prepare_reference

    settings = TrackSettings(radius_px=inputs["radius_px"])
    first, second = (spline_of_image(_image(inputs, name), settings.degree) for name in ("first", "second"))
    reference = prepare_reference(first, np.array(inputs["centre_px"]), settings.radius_px, settings.shape_order)
    warp = register(reference, second, identity_registration(reference).warp, settings).warp
    columns = {"u": 0, "v": 3}
    return {f"{n} of subset {i + 1}": float(row[c]) for i, row in enumerate(warp) for n, c in columns.items()}


def _image(inputs: Inputs, name: str) -> FloatArray:
    grey = np.frombuffer(zlib.decompress(base64.b64decode(inputs[name])), dtype="<u2")
    return grey.reshape(inputs["side"], inputs["side"]).astype(np.float64)


def cameras(inputs: Inputs) -> dict[str, float]:
    """Compute points projected into a camera with distortion, and triangulated from two."""
    from photogram.camera import Camera, StereoRig, triangulate
    from photogram.geometry import RigidTransform

    size = np.array([1280, 1024])
    left, right = (Camera.from_parameters(np.array(inputs[name]), size) for name in ("left", "right"))
    pose = RigidTransform(np.array(inputs["rotation"]), np.array(inputs["translation_m"]))
    pixels = [np.array(inputs[name])[None] for name in ("left_px", "right_px")]
    points = triangulate(StereoRig(left, right, pose), *pixels).position_m[0]
    seen = left.project(np.array(inputs["point_m"]))
    found = {f"{a} of point {i + 1}": float(v) for i, row in enumerate(points) for a, v in zip("xyz", row, strict=True)}
    at = {f"left {a} of point {i + 1}": float(v) for i, row in enumerate(seen) for a, v in zip("xy", row, strict=True)}
    return found | at


def step(inputs: Inputs) -> dict[str, float]:
    """Compute the fit of a release, and the figures of a system by its poles."""
    from shaker.lti.indices import indices
    from shaker.lti.system import LinearSystem
    from shaker.release.record import StepRecord
    from shaker.release.step_fit import fit_step

    samples, rate, size = np.array(inputs["samples"])[None], inputs["sample_rate_hz"], inputs["amplitude_n"]
    model = fit_step(StepRecord("line 1", ("Fz",), "V", samples, rate, "Fz", size), "Fz").model
    omega = 2.0 * np.pi * inputs["frequency_hz"]
    system = LinearSystem.from_coefficients(
        np.array([omega**2]), np.array([1.0, 2.0 * inputs["damping"] * omega, omega**2])
    )
    figures = indices(system)
    found = {
        "overshoot": figures.overshoot,
        "peak gain": figures.peak_gain,
        "frequency of the peak": figures.peak_hz,
        "5 % band": figures.band_5_hz,
        "natural frequency": figures.natural_hz,
    }
    if model is None:
        raise ValueError("no model fits the record")
    return {
        "frequency of the record": float(model.frequency_hz[0]),
        "damping ratio of the record": float(model.damping_ratio[0]),
        **{name: np.nan if value is None else float(value) for name, value in found.items()},
    }


def rotation(inputs: Inputs) -> dict[str, float]:
    """Compute weight and first moment of a body rotated in gravity."""
    from shaker.static_rotation.masses import RotationRecord, SensorOutputs, fit_weights

    amplitude = _complex(inputs, "amplitude")
    axis, down = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    record = RotationRecord("weight", amplitude, inputs["variance"] * np.eye(12), 20.0, axis, down)
    value = fit_weights([record], SensorOutputs(np.array(inputs["sensitivity"]), np.zeros((6, 6)))).value
    names = ("weight", *(f"first moment {axis}" for axis in "xyz"))
    return dict(zip(names, value[:4].tolist(), strict=True))


def _complex(inputs: Inputs, name: str) -> ComplexArray:
    return np.asarray(np.array(inputs[f"{name}_re"]) + 1j * np.array(inputs[f"{name}_im"]))


def matrix(inputs: Inputs) -> dict[str, float]:
    """Compute the 6 × 6 matrix from eight recordings of known loads."""
    from fusion.campaign.excited_line import ExcitedLine
    from fusion.campaign.matrix import fit_matrix
    from fusion.estimation.uncertainty import Contribution, Uncertainty
    from shaker.labels import LOAD_COMPONENTS

    loads, outputs = _complex(inputs, "load"), _complex(inputs, "output")
    load_uncertainty = Uncertainty((Contribution("noise", "A", 1e-24 * np.eye(12)[None]),), ())
    noise = Uncertainty((Contribution("noise", "A", inputs["u_output"] ** 2 * np.eye(12)[None]),), ())
    facts = 100.0, 100.0, (0.0, 0.0, 1.0)
    drives = [
        ExcitedLine(f"run {n}", str(n), *facts, load, load_uncertainty, output, noise, LOAD_COMPONENTS)
        for n, (load, output) in enumerate(zip(loads, outputs, strict=True))
    ]
    value = fit_matrix(drives).value
    found: dict[str, float] = {}
    for i, channel in enumerate(LOAD_COMPONENTS):
        for j in (i, (i + 1) % 6):
            name = f"{channel}/{LOAD_COMPONENTS[j]}"
            found |= {f"re {name}": float(value[i, j].real), f"im {name}": float(value[i, j].imag)}
    return found


def certificate(inputs: Inputs) -> dict[str, float]:
    """Compute coverage factors, magnitude and phase, rounding, and the numbers in the XML."""
    from fusion.estimation.coverage import coverage_factor, polar, region_factor

    found = {"k of infinite degrees of freedom": coverage_factor(np.inf)}
    for dof in inputs["dof"]:
        found |= {
            f"k of {dof:g} degrees of freedom": coverage_factor(dof),
            f"region factor of {dof:g}": float(region_factor(dof)),
        }
    stated = polar(complex(*inputs["value"]), np.array(inputs["covariance"]))
    texts = sum(round_to_uncertainty(value, expanded).text == text for value, expanded, text in inputs["rounding"])
    return found | {
        "magnitude": stated.magnitude,
        "phase": stated.phase_rad,
        "u of the magnitude": stated.u_magnitude,
        "u of the phase": stated.u_phase_rad,
        "texts rounded as JCGM 100, 7.2.6 asks": float(texts),
        **_in_xml(stated, inputs),
    }


def _in_xml(stated: Polar, inputs: Inputs) -> dict[str, float]:
    """Return the numbers in a certificate's XML, of one sensitivity and one mass."""
    from lxml import etree

    from fusion.campaign.recording_results import SensorFacts
    from fusion.sensor.certificate.certificate_evaluation import Certificate, CertifiedElement, CertifiedValue
    from fusion.sensor.certificate.certificate_inputs import CertifiedNumber, Form, NumberList
    from fusion.sensor.certificate.certificate_report import DCC, SI, certificate_xml

    k, mass = stated.k, inputs["mass"]
    value = CertifiedValue(
        80.0, stated, k * stated.u_magnitude, stated.k_phase * stated.u_phase_rad, k, stated.k_phase, True
    )
    named = ("", "", ("Fz",), "V/V", "on_load", None, None, 0.0)
    found = Certificate(
        form=Form(format=1), title="", rig_path=Path("rig.toml"), sensor=SensorFacts(*named), recordings=(),
        begin=date(2026, 1, 1), end=date(2026, 1, 1), procedure="", conditions=(), sources=(),
        elements=(CertifiedElement("Fz", "Fz", "V/V", "element", True, (value,)),),
        numbers=(NumberList("masses", (CertifiedNumber("mass", "mass", mass[0], k * mass[1], k, "kg"),)),),
        warnings=(), not_assessed=(), versions={},
    )  # fmt: skip
    result = etree.fromstring(certificate_xml(found)).iterfind(f".//{{{DCC}}}quantity")
    frequency, size, turn, complex_value, single = (list(quantity.iter(f"{{{SI}}}*")) for quantity in result)

    def numbers(quantity: list[etree._Element], *ends: str) -> list[float]:
        """Texts of elements whose names begin so, in the order of the document."""
        leaves = [e for e in quantity if any(etree.QName(e).localname.startswith(end) for end in ends) and not len(e)]
        return [float(str(e.text)) for e in leaves]

    names = ["frequency", "magnitude", "U of the magnitude", "k", "phase", "U of the phase", "real part"]
    names += ["imaginary part", "variance, re", "covariance", "covariance again", "variance, im", "factor"]
    names += ["mass", "U of the mass"]
    values_found = [
        *numbers(frequency, "value"), *numbers(size, "value", "coverageFactor"), *numbers(turn, "value"),
        *numbers(complex_value, "value", "coverageFactor"), *numbers(single, "value"),
    ]  # fmt: skip
    return {f"XML: {name}": number for name, number in zip(names, values_found, strict=True)}


CASES: dict[str, Callable[[Inputs], dict[str, float]]] = {
    case.__name__: case for case in (sines, trigger, frames, cameras, step, rotation, matrix, certificate)
}
