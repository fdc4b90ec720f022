"""Analysis of one recording after the phasors: fusion, load, sensitivity and the result tree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import ComputeError
from fusion.estimation.estimation_notices import UNBOUNDED_MOTION, UNBOUNDED_READINGS
from fusion.estimation.fuse import Acceleration, fuse_sources
from fusion.estimation.instrument_consistency import (
    OUTPUT_MISTAKES,
    UNTESTABLE_SHARE,
    describe_deviation,
    likely_mistake,
)
from fusion.estimation.labelled_phasors import LabelledPhasors, TabularResult
from fusion.estimation.least_squares import Unbounded, observed_components, row_space
from fusion.estimation.measurement_model import SCALE, CommonError, Deviates, Geometry, Observation, UnobservedMotion
from fusion.estimation.uncertainty import Influence, Uncertainty, added_up, as_complex
from fusion.instruments.channel import ChannelGeometry, Outputs
from fusion.instruments.stereo import StereoReading
from fusion.instruments.vibrometer import PointSpread
from fusion.phasors.phasor_notices import NO_INSTRUMENT
from fusion.recording.placement import measuring_point, placement_name
from fusion.sensitivity.distributions import MonteCarlo
from fusion.sensitivity.elastic import ElasticPart, InstrumentPosition, NaturalModes
from fusion.sensitivity.load_phasors import LoadResult, describe_other_loads, load_phasors
from fusion.sensitivity.moving_body import Body
from fusion.sensitivity.ratio import (
    CHANGED,
    PriorMatrix,
    Sensitivity,
    StatedMatrix,
    contradicting_outputs,
    driven_component,
    mass_notices,
    prior_matrix,
    quotient,
    sensitivity_ratio,
    sensor_element,
)
from fusion.sensitivity.sensitivity_notices import (
    CROSS_TALK_BOUND,
    DIRECTION_DOUBTED,
    ELEMENT_CHANGED,
    OTHER_LOADS_NOT_ASSESSED,
    OUTPUT_CONTRADICTS,
    POSITION_UNSTATED,
    REPEATABILITY_NOT_ASSESSED,
)
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shaker.lines.frequencies import LineFrequencies
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.phasors.channel_phasors import ChannelResult
    from fusion.phasors.set_up_merging import SetUpResult
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.phasors.timing import ClockResult
    from fusion.recording.load import Manifest
    from fusion.recording.rig import Sensor
    from fusion.sensitivity.supports import SupportMotion

# Instruments on an elastic load: rows for the motion of its foot.


@dataclass(frozen=True)
class ElasticGeometry(Geometry):
    """Geometry of an instrument on an elastic load, for Monte Carlo.

    `inner`: its geometry on a rigid load with rows `rigid`. `stretch` (K, M, 6, 6): additional motion of its positions
    relative to the foot. `shifted_positions`: for uncertain positions the names of the unknowns of the M channels and
    the change of `stretch` per standard uncertainty of each.
    """

    inner: Geometry
    rigid: ComplexArray
    stretch: ComplexArray
    shifted_positions: tuple[tuple[tuple[str, ...], ComplexArray], ...]

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` and `moved` draw."""
        return self.inner.unknowns

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return rows (N, K, M, 6) of drawn positions and directions on the elastic load."""
        rigid = self.inner.rows(self.rigid, deviates)
        total = np.repeat(self.stretch[None], deviates.count, axis=0)
        for names, change in self.shifted_positions:
            size = np.stack([deviates.normal(name) for name in names], axis=1)
            total += size[:, None, :, None, None] * change
        return np.asarray(rigid + np.einsum("nkmj,nkmji->nkmi", rigid, total))

    def moved(self, readings: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return readings as instruments in N other places give them."""
        return self.inner.moved(readings, deviates)


def elastic_rows(observations: Sequence[Observation], parts: Sequence[ElasticPart]) -> tuple[Observation, ...]:
    """Return instruments on an elastic load with rows for the motion of its foot.

    Rows are design · (I + stretch). Uncertain numbers of the modes are common errors, with the names under which they
    act on the load. Elastic effects of components that are not observed on a rigid load do not change which components
    are observed.
    """
    of_load = [observation for observation in observations if observation.body == "load"]
    if not parts or not of_load:
        return tuple(observations)
    lines = range(len(of_load[0].phasors.frequency_hz))
    seen = np.array([observed_components(row_space(of_load, line)) for line in lines])
    return tuple(_stretched(o, parts, seen) if o.body == "load" else o for o in observations)


def _stretched(observation: Observation, parts: Sequence[ElasticPart], seen: BoolArray) -> Observation:
    """Return one instrument on the elastic load; `seen` (K, 6): components that any instrument observes."""
    frequency, rigid, inner = observation.phasors.frequency_hz, observation.design, observation.geometry
    positions = _positions(observation)
    stretch = _stretch(parts, frequency, positions, rigid.shape[1])
    # Errors of positions act on the observed part of the elastic motion; the readings include its unobserved part.
    observed_stretch = np.where(seen[:, None, None, :], stretch, 0.0)
    slopes = {
        error.name: error.slope + _rows(error.slope, observed_stretch if error.name in inner.unknowns else stretch)
        for error in observation.common
    }
    shifted_positions = tuple(_shifted_positions(parts, frequency, inner, positions))
    for names, change in shifted_positions:
        for index, name in enumerate(names):
            if name in slopes:
                slopes[name][:, index] += np.where(seen, _rows(rigid, change)[:, index], 0.0)
    none = np.zeros(rigid.shape[:2], np.complex128)
    common = [replace(error, slope=slopes[error.name]) for error in observation.common]
    for part in parts:
        for c in part.changes(lambda modes: _stretched_positions(modes, frequency, positions, rigid.shape[1])):
            # Where a number is stated too high, the readings are those of rows with less of it.
            slope = -np.where(seen[:, None, :], _rows(rigid, c.effect), 0.0)
            common.append(CommonError(c.name, c.label, c.u, c.unit, c.scope, slope, none))
    main = observation.main_design
    return replace(
        observation,
        design=rigid + _rows(rigid, stretch),
        common=tuple(common),
        geometry=ElasticGeometry(inner, rigid, stretch, shifted_positions),
        main=main + np.where(seen[:, None, :], _rows(main, stretch), 0.0),
    )


def _rows(design: ComplexArray, stretch: ComplexArray) -> ComplexArray:
    """Return rows (K, M, 6) of the elastic motion."""
    return np.asarray(np.einsum("kmj,kmji->kmi", design, stretch))


def _stretched_positions(
    modes: NaturalModes, frequency_hz: FloatArray, positions: Sequence[InstrumentPosition], rows: int
) -> ComplexArray:
    """Return the elastic motion (K, M, 6, 6) of M rows."""
    each = np.stack([modes.stretch(frequency_hz, position) for position in positions], axis=1)
    return np.repeat(each, rows // len(positions), axis=1)


def _stretch(
    parts: Sequence[ElasticPart], frequency_hz: FloatArray, positions: Sequence[InstrumentPosition], rows: int
) -> ComplexArray:
    """Return the corrected elastic motion (K, M, 6, 6) of M rows by all parts."""
    return np.asarray(
        sum(part.act(lambda modes: _stretched_positions(modes, frequency_hz, positions, rows)) for part in parts)
    )


def _shifted_positions(
    parts: Sequence[ElasticPart], frequency_hz: FloatArray, inner: Geometry, positions: Sequence[InstrumentPosition]
) -> Iterator[tuple[tuple[str, ...], ComplexArray]]:
    """Yield the unknowns of uncertain positions, and the change of the stretch."""
    if not isinstance(inner, ChannelGeometry) or inner.transducer.rotational:
        return
    for unit, letter in zip(np.eye(3), "xyz", strict=True):
        shifts = [unit * np.broadcast_to(entry.point_uncertainty, 3) for entry in inner.entries]
        if np.any(shifts):
            ahead, behind = (
                [
                    replace(position, point_m=position.point_m + sign * shift)
                    for position, shift in zip(positions, shifts, strict=True)
                ]
                for sign in (1.0, -1.0)
            )
            both = (_stretch(parts, frequency_hz, side, len(positions)) for side in (ahead, behind))
            change = np.subtract(*both) / 2.0
            yield tuple(placement_name(entry, "point", letter) for entry in inner.entries), np.asarray(change)


def _positions(observation: Observation) -> list[InstrumentPosition]:
    """Return the positions of an instrument's channels, or of a pair's face."""
    seen = observation.geometry
    if isinstance(seen, ChannelGeometry):
        missing = [entry.name for entry in seen.entries if entry.point is None]
        if missing:
            raise ComputeError(POSITION_UNSTATED, instrument=f"channel {missing[0]}", key="point")
        return [InstrumentPosition(entry.name, measuring_point(entry)) for entry in seen.entries]
    if isinstance(seen, StereoReading) and seen.face_m is not None:
        return [InstrumentPosition(seen.name, seen.face_m)]
    raise ComputeError(POSITION_UNSTATED, instrument=observation.title, key="subsets of its images")


# From the phasors of all instruments to acceleration, load and sensitivity.


@dataclass(frozen=True)
class Inputs:
    """Phasors and manifests of one recording, as the analysis needs them.

    `lines`: the K lines. `observations`: instruments as rows of the linear model. `outputs`: of the `sensor`. `body`:
    all moving parts above the elastic element, None without a load. `direction`: 3 or 6 numbers. `unobserved_motion`:
    its assumed limits.
    """

    lines: LineFrequencies
    observations: tuple[Observation, ...]
    outputs: Outputs | None = None
    body: Body | None = None
    sensor: Sensor | None = None
    direction: tuple[float, ...] | None = None
    unobserved_motion: UnobservedMotion = field(default_factory=UnobservedMotion)


@dataclass(frozen=True, repr=False)
class Analysis(Arrays):
    """Acceleration of every body, load and sensitivity of one recording.

    `accelerations`: fused first, then by source. `outputs`: of the sensor, corrected by the estimates of shared errors.
    `sensitivity`: their ratios to the driven load. `element`: elements of the sensor, with its `prior_matrix`; None
    without one. `doubts`: notices of the direction of the excitation.
    """

    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None
    element: Sensitivity | None = None
    prior_matrix: PriorMatrix | None = None
    doubts: tuple[Notice, ...] = ()

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Return the notices of fusion, load and sensitivity."""
        results = [*(a for a in self.accelerations if a.source == "fused"), self.load, self.sensitivity]
        results.append(self.element)
        return (*self.doubts, *(notice for result in results if result is not None for notice in result.notices))


NOT_SHOWN = ("repeatability", "mounting anew")
"""What one recording does not show: lines of its budget without a number."""
REPEATS = "repeats"
"""Where notices on repeatability belong; those of a campaign replace those of its recordings."""


def driven_motion(direction: Sequence[float], body: Body | None = None) -> tuple[float, ...]:
    """Return the driven motion (6,), translations and rotations times 0.1 m, as a unit vector.

    Each of six load components drives the motion along or about its axis: force over mass, moment over moment of
    inertia at the sensor origin. Without a body, or for a point mass, the radius of gyration is 0.1 m.
    """
    inertia = SCALE**-2.0
    if body is not None:
        diagonal = np.diag(body.rigid.mass_matrix)
        inertia = np.where(diagonal > 0.0, diagonal, diagonal[0] * inertia)
    whole = np.zeros(6)
    whole[: len(direction)] = direction
    motion = whole / inertia / SCALE
    return tuple((motion / np.linalg.norm(motion)).tolist())


OTHER_AXIS = 2.0
"""Observed motion across the stated direction over that along it: more is no shaker's, unless it resonates."""


def _direction_doubts(fused: Acceleration) -> Iterator[Notice]:
    """Yield a warning where the largest observed motion is across the stated direction."""
    drive = np.array(fused.unobserved_limits.drive or (0.0,) * 6)
    motion = np.where(fused.observed, fused.phasors.value, 0.0) / SCALE
    line = int(np.argmax(np.linalg.norm(motion, axis=1)))
    along = abs(motion[line] @ drive)
    across = np.abs(motion[line] - drive * (motion[line] @ drive))
    c = int(np.argmax(across))
    if np.all(fused.observed[line] | (drive == 0.0)) and across[c] > OTHER_AXIS * along:
        yield Notice(
            DIRECTION_DOUBTED,
            "excitation.direction",
            component=MOTION_COMPONENTS[c],
            body=fused.body,
            across=across[c],
            unit="m/s²" if c < 3 else f"m/s² at {1.0 / SCALE[c]:g} m",
            frequency_hz=fused.phasors.frequency_hz[line],
            along=along,
        )


def analyse(inputs: Inputs) -> Analysis:
    """Fuse all instruments of every body, and compute load and sensitivity.

    Raises `ComputeError` if no instrument measures a motion, or if every reading of the load may contain a driven
    motion without limit.
    """
    seen, direction = inputs.observations, inputs.direction
    unobserved_motion = replace(
        inputs.unobserved_motion, drive=driven_motion(direction, inputs.body) if direction is not None else None
    )
    accelerations, doubts = list[Acceleration](), list[Notice]()
    for body in (body for body in ("load", "base") if any(observation.body == body for observation in seen)):
        try:
            accelerations += fuse_sources(seen, body, unobserved_motion)
        except Unbounded as error:
            of_body = [observation for observation in seen if observation.body == body]
            compared = ", ".join(o.title for o in of_body if any(other.stated for other in of_body) and not o.stated)
            unused = f"; {compared} states no systematic uncertainty and is not used" if compared else ""
            values = {**error.values, "unused": unused}
            if body == "load":
                raise Unbounded(UNBOUNDED_READINGS, body, **values) from error
            doubts.append(Notice(UNBOUNDED_MOTION, body, **values))
    if not accelerations and not doubts:
        raise ComputeError(NO_INSTRUMENT, quantity="a motion", reason="")
    fused = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None)
    doubts += [] if fused is None else _direction_doubts(fused)
    return replace(_sensor(inputs, tuple(accelerations), fused), doubts=tuple(doubts))


def _sensor(inputs: Inputs, accelerations: tuple[Acceleration, ...], fused: Acceleration | None) -> Analysis:
    """Return the load by the fused acceleration, and the outputs over it."""
    outputs, sensor, direction = inputs.outputs, inputs.sensor, inputs.direction
    if inputs.body is None or fused is None:
        return Analysis(accelerations, None, outputs, None)
    load = load_phasors(fused, inputs.body)
    if sensor is None or direction is None or outputs is None:
        return Analysis(accelerations, load, outputs, None)
    outputs = with_estimates(outputs, fused)
    component = driven_component(direction, sensor.capacity)
    ratio = sensitivity_ratio(outputs, load, component, inputs.lines.multiple)
    if np.any(np.isfinite(ratio.value)):
        ratio = replace(ratio, notices=(Notice(REPEATABILITY_NOT_ASSESSED, REPEATS),))
    sizes = np.nanmax(np.nan_to_num(np.abs(ratio.value[:, :, component])), axis=0)
    prior = prior_matrix(StatedMatrix.of(sensor), outputs.phasors.channels, component, sizes)
    notices = _element_notices(prior, outputs, load, sensor, component)
    if prior is None:
        return Analysis(accelerations, load, outputs, replace(ratio, notices=(*ratio.notices, *notices)))
    element = sensor_element(outputs, load, prior, inputs.lines.multiple, notices)
    if not np.isfinite(element.value[:, prior.main, component]).any():
        return Analysis(accelerations, load, outputs, ratio)
    return Analysis(accelerations, load, outputs, ratio, element, prior)


ESTIMATE_NOISE = "noise of the estimate of shared unknowns"
"""Label of the noise in estimates of clocks, amplifiers and other unknowns shared with outputs."""
COUPLED = 1e-2
"""Share of an unknown in the remaining standard uncertainty of another one above which it is named (chosen)."""


def with_estimates(outputs: Outputs, fused: Acceleration) -> Outputs:
    """Return the outputs corrected by the estimates of the errors that they share with instruments.

    An output U with the shared error o·ε enters the least squares of the instruments as a reading with a free motion,
    which does not change the estimate of ε. It becomes U·exp(-o·ε̂/U) with the posterior mean ε̂ of the instruments and
    its covariance S (both in u). Errors of a chain are relative: a clock error turns a phasor and keeps its magnitude.

    The remaining error o·(ε - ε̂) = o·S·ε - o·S·(noise) is in their unknowns by name, and in noise of covariance o·(S -
    S²)·oᵀ without couplings below `COUPLED`. This noise also acts on the load, which is not used: U of their ratio is
    slightly too large. Unknowns that the instruments cannot test, or that contradict each other, are unchanged.
    """
    if fused.posterior is None:
        return outputs
    influences = {influence.name: influence for influence in outputs.uncertainty.influences}
    tested = [
        (index, u) for index, u in enumerate(fused.unknowns) if u.name in influences and u.remaining < UNTESTABLE_SHARE
    ]
    if not tested:
        return outputs
    effects = np.stack([influences[u.name].effect for _, u in tested])
    finite, rows = np.isfinite(effects), fused.posterior[[index for index, _ in tested]]
    effects = np.where(finite, effects, 0.0)
    share = np.abs(rows) / np.array([[u.remaining] for _, u in tested])
    coupled, common = np.flatnonzero(share.max(axis=0) > COUPLED), fused.uncertainty.influences
    left = [common[e].acting(np.einsum("c,ckj->kj", rows[:, e], effects)) for e in coupled.tolist()]
    indices = [index for index, _ in tested]
    size, modes = np.linalg.eigh(rows[:, indices] - rows[:, coupled] @ rows[:, coupled].T)
    for number, mode in enumerate((modes * np.sqrt(np.maximum(size, 0.0))).T, 1):
        name = f"{ESTIMATE_NOISE} {number}"
        left.append(Influence(name, ESTIMATE_NOISE, 1.0, "1", np.einsum("c,ckj->kj", mode, effects), "recording", "A"))
    remaining = [influence for name, influence in influences.items() if name not in {u.name for _, u in tested}]
    uncertainty = Uncertainty(outputs.uncertainty.random, added_up([*remaining, *left]))
    value = outputs.phasors.value
    change = as_complex(np.einsum("c,ckj->kj", [u.estimate for _, u in tested], effects))
    value = value * np.exp(-np.divide(change, value, out=np.zeros_like(value), where=value != 0.0))
    return replace(
        outputs,
        phasors=replace(outputs.phasors, value=value, covariance=uncertainty.covariance),
        uncertainty=uncertainty,
    )


def _element_notices(
    prior: PriorMatrix | None, outputs: Outputs, load: LoadResult, sensor: Sensor, component: int
) -> tuple[Notice, ...]:
    """Return the missing corrections of the element and its contradictions with the static matrix."""
    named = LOAD_COMPONENTS[component]
    if prior is None:
        others = describe_other_loads(load, component, sensor.capacity)
        note = Notice(OTHER_LOADS_NOT_ASSESSED, "sensitivity", component=named, loads=others)
        return (note, *_far_from_static(outputs, load, sensor, component))
    element = f"element {prior.channels[prior.main]} per {named}"
    if not prior.static:
        note = Notice(CROSS_TALK_BOUND, "sensitivity", element=element, cross_talk=sensor.cross_talk or 0.0)
        return (note, *_far_from_static(outputs, load, sensor, component))
    # Of the output that the driven load moves most, at the strongest line.
    line = int(np.argmax(np.nan_to_num(np.abs(load.value[:, component]))))
    if not load.observed[line].any():
        return ()  # instruments that contradict each other leave no load
    frequency_hz = float(outputs.phasors.frequency_hz[line])
    predicted = load.value[line] @ prior.value[prior.main]
    change = complex(quotient(outputs.phasors.value[line, prior.main], np.asarray(predicted)))
    notices = list(contradicting_outputs(outputs, load, prior, StatedMatrix.of(sensor).rated, line))
    notices += mass_notices(element, change, frequency_hz)
    if abs(change - 1.0) > CHANGED:
        notices.append(
            Notice(
                ELEMENT_CHANGED,
                "sensitivity",
                element=element,
                factor=abs(change),
                angle_rad=np.angle(change),
                frequency_hz=frequency_hz,
            )
        )
    return tuple(notices)


def _far_from_static(outputs: Outputs, load: LoadResult, sensor: Sensor, component: int) -> Iterator[Notice]:
    """Yield a warning of an output far from its static value, without a whole matrix."""
    if sensor.static_sensitivity is None:
        return
    main = main_output(sensor, component, outputs.phasors.channels)
    force = np.nan_to_num(load.value[:, component])
    line = int(np.argmax(np.abs(force)))
    if main is None or not np.abs(force[line]) > 0.0:
        return
    static = sensor.static_sensitivity[list(sensor.channels).index(main)][component]
    index, predicted = outputs.phasors.channels.index(main), complex(static * force[line])
    ratio = complex(outputs.phasors.value[line, index]) / predicted
    noise = float(np.hypot(outputs.phasors.u_re[line, index], outputs.phasors.u_im[line, index])) / abs(predicted)
    if not abs(ratio - 1.0) > CHANGED + 3.0 * noise:
        return
    mistake = likely_mistake(ratio, CHANGED, OUTPUT_MISTAKES)
    checks = (
        "sensor.static_sensitivity, sensor.unit, sensor.sense and load.mass, scale, direction and response of channels"
    )
    yield Notice(
        OUTPUT_CONTRADICTS,
        "sensitivity",
        frequency_hz=outputs.phasors.frequency_hz[line],
        outputs=describe_deviation(main, ratio, mistake),
        checks=checks,
        mistake_explains=bool(mistake),
    )


def main_output(sensor: Sensor, component: int, recorded: Sequence[str] | None = None) -> str | None:
    """Return the recorded output that belongs to a load by matrix or name, or None."""
    names = [name for name in sensor.channels if recorded is None or name in recorded]
    if sensor.static_sensitivity is not None:
        size = {name: abs(row[component]) for name, row in zip(sensor.channels, sensor.static_sensitivity, strict=True)}
        main = max(names, key=lambda name: size[name], default=None)
        return main if main is not None and size[main] > 0.0 else None
    return LOAD_COMPONENTS[component] if LOAD_COMPONENTS[component] in names else None


# The result tree of one recording, for result files and report.


@dataclass(frozen=True, repr=False)
class Evaluation(TabularResult):
    """All results of one recording.

    Attributes
    ----------
    manifest : the manifest of the recording.
    lines : the lines with their frequencies.
    clocks, channels, stereo : results of DAQ blocks, channels and stereo pairs.
    accelerations : one entry per body and source, `fused` first.
    load : wrench phasors at the sensor origin in N and N.m, with the manifest's sense; None without a load.
    outputs : outputs of the sensor.
    sensitivity : ratios of outputs to the driven load.
    notices : notices of all stages.
    settings, versions, input_hashes : settings, program versions, and SHA-256 of each input file.
    duration_s : duration of the evaluation, s.
    set_ups : ties of sequential set-ups; empty for one.
    points : vibrometer points along one direction.
    monte_carlo : Monte Carlo results, if requested.
    element : elements of the sensor under the driven load, if its matrix is stated.
    supports : motion of supports with a reference at rest.
    """

    manifest: Manifest
    lines: LineFrequencies
    clocks: tuple[ClockResult, ...]
    channels: tuple[ChannelResult, ...]
    stereo: tuple[StereoResult, ...]
    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float = 0.0
    set_ups: tuple[SetUpResult, ...] = ()
    points: tuple[PointSpread, ...] = ()
    monte_carlo: MonteCarlo | None = None
    element: Sensitivity | None = None
    supports: tuple[SupportMotion, ...] = ()

    @property
    def stated_component(self) -> int | None:
        """Load component (0 to 5) along the stated excitation, None without a direction."""
        direction, sensor = self.manifest.excitation.direction, self.manifest.rig.sensor
        return None if direction is None else driven_component(direction, None if sensor is None else sensor.capacity)

    @property
    def _main_result(self) -> TabularResult | None:
        return self.element or self.sensitivity or self.load or next(iter(self.accelerations), None)

    def labelled(self) -> LabelledPhasors:
        """Return the main result: elements of the sensor, else ratios, the load, or accelerations."""
        if self._main_result is None:
            raise ValueError(f"{self.manifest.name}: expected a result, found none; its notices state why")
        return self._main_result.labelled()

    def __repr__(self) -> str:
        result = self._main_result
        warnings = sum(notice.severity == "warning" for notice in self.notices)
        text = f"{self.manifest.name}: {'no result' if result is None else result!r}"
        return f"{text}; {warnings} warning{'s' * (warnings != 1)}"
