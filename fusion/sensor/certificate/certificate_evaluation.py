"""Evaluation of a certificate: results of recordings with the statements of the laboratory."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from fusion.campaign.curve import CurvePoint
from fusion.campaign.joint_evaluation import (
    CampaignEvaluation,
    best_points,
    curve_points,
    evaluate_campaign,
    main_channel,
)
from fusion.campaign.recording_results import RecordingResults, SensorFacts, read_recorded
from fusion.errors import InputError
from fusion.phasors.phasor_notices import (
    CAMERA_DELAYED,
    COARSE_CONVERTER_STEPS,
    COARSE_ROWS,
    PERIODIC_JITTER,
    SHUTTER_NOT_CONVERGED,
)
from fusion.recording.acknowledged import acknowledge
from fusion.recording.excitation import kinds_of
from fusion.recording.load import RECORDING_NAME, Manifest, find_recordings, load_manifest, select_kinds
from fusion.recording.toml import UncertainInput
from fusion.report.folder import hash_files, sha256
from fusion.report.table import has_phase
from fusion.report.tables import result_name
from fusion.sensitivity.load_phasors import budget
from fusion.sensitivity.ratio import driven_component
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_content import (
    Certificate,
    CertificateContent,
    CertifiedBudget,
    CertifiedElement,
    CertifiedLoad,
    CertifiedMass,
    CertifiedValue,
    UnderlyingCertificate,
    Verdict,
)
from fusion.sensor.certificate.certificate_form import FORM_FILE, Conformity, Form, read_form
from fusion.sensor.certificate.certificate_inputs import (
    CERTIFIED_COMMANDS,
    find_command,
    find_results_folder,
    read_certified_numbers,
    read_results_origin,
    select_recordings,
)
from fusion.sensor.certificate.certificate_refusals import (
    calibration_days,
    refusal_of,
    refusals,
    unacknowledged,
)
from fusion.sensor.certificate.certificate_traceability import MainValue, least_certified
from fusion.sensor.model_notices import MODEL_INFLUENCES_NOT_ASSESSED
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.notices import Notice

NOT_IN_U = {
    notice.code
    for notice in (CAMERA_DELAYED, COARSE_ROWS, SHUTTER_NOT_CONVERGED, PERIODIC_JITTER, COARSE_CONVERTER_STEPS)
}
"""Codes of warnings of an effect that U does not include."""
NOT_IN_U_WITHOUT_CODE = ("not assessed", "not in U")
"""Phrases of such notices in results of older versions, whose notices have no code."""
SAME_LINE = 1e-3
"""Relative difference below which frequencies of recordings belong to one value; lines are further apart."""
MISSING = re.compile(r"([^:`]+): ")
"""Beginning of a notice that names an influence before the keys that are missing."""
LEFT_OUT = re.compile(r"does not include (.+?)\.$")


def evaluate_certificate(
    path: Path,
    results: Path | None = None,
    form_path: Path | None = None,
    *,
    allow_outside: bool = False,
    specimen: bool = False,
) -> Certificate:
    """Collect the content of a certificate of a campaign or a recording.

    `results`: folder of results of `run`, `rotate`, `identify` or `step`, by default that of `find_results_folder`.
    `form_path`: certificate.toml, by default in the same folder. `specimen`: accept simulated recordings. Raises one
    `InputError` with all reasons that refuse the certificate.
    """
    recordings = find_recordings(path)
    is_single = not path.is_dir() or (path / RECORDING_NAME).is_file()
    folder = recordings[0].parent if is_single else path
    top = find_results_folder(folder, results)
    command = find_command(top)
    if command is not None:
        recordings = select_recordings(recordings, top, command)
    elif not is_single:
        recordings = select_kinds(recordings, kinds_of("run"), images=True)
    form_path = folder / FORM_FILE if form_path is None else form_path
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in recordings]
    problems = list[InputError]()
    form: Form | None = None
    try:
        form = _named(read_form(form_path), manifests[0])
    except InputError as error:
        problems += error.each
    problems += refusals(form, form_path, manifests, specimen=specimen)
    content: CertificateContent | None = None
    try:
        stated = form or Form(format=1)
        if command is None:
            folders = [top] if is_single else [top / manifest.folder.name for manifest in manifests]
            content = _sensitivities(folder.resolve().name, manifests, folders, top, stated, form_path)
        else:
            content = _numbers(command, manifests, top, stated)
        problems += unacknowledged(content.warnings, form_path)
    except InputError as error:
        problems += error.each
    if form is None or content is None or problems:
        raise refusal_of(problems, form_path)
    return _certificate(content, form, manifests)


def _certificate(content: CertificateContent, form: Form, manifests: Sequence[Manifest]) -> Certificate:
    """Return the content with the statements of form and manifests."""
    days = calibration_days(form, manifests)
    gravity = [manifest.rig.surroundings.free_fall_mps2[0] for manifest in manifests]
    down = [tuple((np.array(g) / np.linalg.norm(g)).round(6).tolist()) for g in gravity if g is not None]
    load = manifests[0].rig.load
    return Certificate(
        **vars(content),
        form=form,
        rig_path=manifests[0].rig_path,
        recordings=tuple(manifest.folder.name for manifest in manifests),
        begin=min(days),
        end=max(days),
        procedure=form.administration.procedure or ", ".join(sorted({m.procedure or "" for m in manifests} - {""})),
        conditions=tuple(_conditions(form, manifests)),
        sources=_sources([item for manifest in manifests for item in manifest.inputs]),
        loads=_loads(manifests) if content.elements else (),
        down=tuple(dict.fromkeys(down)),
        centre_m=() if load is None else load.centre_of_mass,
        specimen=any(manifest.simulated for manifest in manifests),
    )


def _sensitivities(
    name: str, manifests: Sequence[Manifest], folders: Sequence[Path], top: Path, form: Form, form_path: Path
) -> CertificateContent:
    """Return the sensitivities of a campaign `name`, or of a recording, from results of `run`."""
    recorded = [_results_of(manifest, folder) for manifest, folder in zip(manifests, folders, strict=True)]
    evaluation = evaluate_campaign(name, recorded, {})
    sensor = evaluation.sensor
    if sensor is None:
        raise _no_sensor(manifests)
    elements = tuple(_elements(evaluation, sensor, form))
    if not elements:
        raise InputError(declared.NO_CERTIFIABLE_RESULT, top, expected="results with outputs over a driven load")
    ratios = all(element.kind == "ratio" for element in elements)
    stated = [*form.acknowledged, *(one for manifest in manifests for one in manifest.acknowledged)]
    notices = acknowledge(chain(*(_of_recording(entry) for entry in recorded), evaluation.notices), stated)
    return CertificateContent(
        title="Output over driven load" if ratios else "Dynamic sensitivity",
        sensor=sensor,
        elements=elements,
        **_split(notices, [*chain(*(entry.joint_notices for entry in recorded)), *evaluation.notices]),
        versions=recorded[0].origin.versions,
        shares=least_certified(
            _main_values(evaluation),
            (row for entry in recorded for row in entry.evidence),
            form.equipment,
            form_path,
        ),
    )


def _main_values(evaluation: CampaignEvaluation) -> Iterator[MainValue]:
    """Yield every main value, ratios only if there is nothing else."""
    kinds = {curve.kind for curve in evaluation.curves}
    kind = next((kind for kind in ("matrix", "element", "ratio") if kind in kinds), None)
    for curve in (curve for curve in evaluation.curves if curve.kind == kind):
        for e, (channel, component) in enumerate(curve.elements):
            if channel != main_channel(evaluation, curve.channels, component):
                continue
            uncertainty = curve.uncertainty.at([e])
            name = result_name(curve.kind, curve.channels[channel], LOAD_COMPONENTS[component], main=True)
            for line in np.flatnonzero(np.isfinite(curve.value[:, e])).tolist():
                frequency_hz = float(curve.frequency_hz[line])
                yield name, frequency_hz, curve.value[[line]][:, [e]], uncertainty.at_lines([line])


def _numbers(command: str, manifests: Sequence[Manifest], folder: Path, form: Form) -> CertificateContent:
    """Return the numbers of another command's results, which must be those of the present files."""
    origin, notices, scopes = read_results_origin(folder, command)
    for name, digest in origin.input_hashes.items():
        path = manifests[0].root / name
        if not path.is_file() or sha256(path) != digest:
            raise InputError(declared.OUTDATED_RESULTS, folder, expected="these files", changed=name, command=command)
    tested = {(m.rig.sensor.name, m.rig.sensor.serial) for m in manifests if m.rig.sensor is not None}
    sensor = manifests[0].rig.sensor
    if len(tested) != 1 or sensor is None:
        raise _no_sensor(manifests)
    facts = SensorFacts(sensor.name, sensor.serial, sensor.channels, sensor.unit, sensor.sense, None, None, 0.0)
    found = _split(acknowledge(notices, form.acknowledged), notices)
    return CertificateContent(
        title=CERTIFIED_COMMANDS[command].title,
        sensor=facts,
        numbers=read_certified_numbers(folder, command, least_k=form.least_k),
        **{**found, "not_assessed": (*scopes, *found["not_assessed"])},
        versions=origin.versions,
    )


def _no_sensor(manifests: Sequence[Manifest]) -> InputError:
    found = "no sensor, or several" if manifests[0].rig.sensor else "no sensor"
    return InputError(declared.NOT_ONE_SENSOR, manifests[0].rig_path, "sensor", found=found)


def _named(form: Form, manifest: Manifest) -> Form:
    """Return the form, with the laboratory of rig.toml if it names none."""
    stated = manifest.rig.administration
    if form.laboratory.name or stated is None or not stated.laboratory:
        return form
    return form.model_copy(update={"laboratory": form.laboratory.model_copy(update={"name": stated.laboratory})})


def _results_of(manifest: Manifest, folder: Path) -> RecordingResults:
    """Read the results of a recording, which must be those of its present files."""
    recorded = read_recorded(folder)
    now, then = hash_files(manifest.files, manifest.root, manifest.file_identities).hashes, recorded.origin.input_hashes
    if now != then:
        changed = min(name for name in {*now, *then} if now.get(name) != then.get(name))
        raise InputError(declared.OUTDATED_RESULTS, folder, expected=str(manifest.path), changed=changed, command="run")
    return recorded


def _elements(evaluation: CampaignEvaluation, sensor: SensorFacts, form: Form) -> Iterator[CertifiedElement]:
    """Yield every element to be stated, the main ones first; of other outputs no ratios."""
    points = curve_points(evaluation)
    mains = {
        component: sensor.channels[main_channel(evaluation, sensor.channels, index)]
        for index, component in enumerate(LOAD_COMPONENTS)
    }
    names = list(dict.fromkeys((point.channel, point.component) for point in points))
    for channel, component in sorted(names, key=lambda name: name[0] != mains[name[1]]):
        named = (channel, component)
        of_element = best_points([point for point in points if (point.channel, point.component) == named])
        main = mains[component] == channel
        if not main and of_element[0].kind == "ratio":
            continue
        values = tuple(_stated(point, _amplitude(evaluation, point), form) for point in of_element)
        deviation = _deviation(of_element, form) if main else ()
        yield CertifiedElement(
            channel=channel,
            component=component,
            unit=sensor.unit,
            kind=of_element[0].kind,
            main=main,
            values=values,
            deviation=deviation,
            verdicts=_verdicts(deviation, form.conformity),
            budget=_budget(evaluation, of_element) if main else None,
            points=tuple(of_element),
        )


def _stated(point: CurvePoint, amplitude: tuple[float, float], form: Form) -> CertifiedValue:
    """Return a value with U = k·u, at capability the stated capability."""
    element, capability = point.element, form.laboratory.cmc
    k, k_phase = max(element.k, form.least_k), max(element.k_phase, form.least_k)
    return CertifiedValue(
        frequency_hz=point.frequency_hz,
        element=element,
        expanded_magnitude=max(k * element.u_magnitude, capability.magnitude * element.magnitude),
        expanded_phase_rad=max(k_phase * element.u_phase_rad, capability.phase),
        k=k,
        k_phase=k_phase,
        has_phase=has_phase(element),
        amplitude=amplitude,
    )


def _amplitude(evaluation: CampaignEvaluation, point: CurvePoint) -> tuple[float, float]:
    """Return the smallest and largest amplitude of the load behind a value."""
    component, sensor = LOAD_COMPONENTS.index(point.component), evaluation.sensor
    capacity = None if sensor is None or sensor.capacity is None else sensor.capacity.tolist()
    lines = [
        line
        for line in evaluation.excited_lines
        if abs(line.frequency_hz / point.frequency_hz - 1.0) < SAME_LINE and np.isfinite(line.load[component])
    ]
    driven = [abs(line.load[component]) for line in lines if driven_component(line.direction, capacity) == component]
    every = [abs(line.load[component]) for line in lines]
    sizes = driven if driven and point.kind != "matrix" else [max(every, default=np.nan)]
    return float(min(sizes)), float(max(sizes))


def _budget(evaluation: CampaignEvaluation, points: Sequence[CurvePoint]) -> CertifiedBudget | None:
    """Return the budget of the point with the largest relative U."""
    worst = max(points, key=lambda point: point.element.expanded_magnitude / point.element.magnitude)
    for curve in evaluation.curves:
        names = [(curve.channels[c], LOAD_COMPONENTS[j]) for c, j in curve.elements]
        lines = np.flatnonzero(curve.frequency_hz == worst.frequency_hz)
        if curve.kind == worst.kind and (worst.channel, worst.component) in names and len(lines):
            element = names.index((worst.channel, worst.component))
            uncertainty = curve.uncertainty.at([element]).at_lines(lines[:1])
            value = curve.value[lines[:1]][:, [element]]
            if np.isfinite(value).all():
                return CertifiedBudget(worst.frequency_hz, worst.element, budget(uncertainty, value))
    return None


def _deviation(points: Sequence[CurvePoint], form: Form) -> tuple[tuple[float, float, float], ...]:
    """Return relative deviations from the static sensitivity with U and k; none without one."""
    if any(point.relative is None for point in points):
        return ()
    found, least = [point.relative for point in points if point.relative is not None], form.laboratory.cmc.magnitude
    k = [max(relative.k, form.least_k) for relative in found]
    return tuple(
        (relative.magnitude - 1.0, max(factor * relative.u_magnitude, least * relative.magnitude), factor)
        for factor, relative in zip(k, found, strict=True)
    )


def _verdicts(deviation: Sequence[tuple[float, float, float]], limit: Conformity | None) -> tuple[Verdict, ...]:
    """Return the conformity of relative deviations with U.

    ISO/IEC 17025:2017, 7.8.6; ILAC-G8:09/2019: "simple" accepts up to the limit, "guarded" up to the limit less U.
    """
    if limit is None:
        return ()
    guard = 1.0 if limit.rule == "guarded" else 0.0
    return tuple(
        "pass" if abs(value) + guard * expanded <= limit.tolerance else "fail" for value, expanded, _ in deviation
    )


def _of_recording(entry: RecordingResults) -> Iterator[Notice]:
    """Yield the notices of a recording with its name."""
    yield from (notice.at(entry.name) for notice in entry.joint_notices)


def _split(notices: Iterable[Notice], unnamed: Iterable[Notice]) -> dict[str, Any]:
    """Return unacknowledged warnings, acknowledged kinds of notices, and influences outside U.

    `unnamed`: the same notices without names of recordings.
    """
    kinds: dict[tuple[str, str], list[Notice]] = {}
    warnings: dict[str, Notice] = {}
    for notice in notices:
        if notice.acknowledged:
            kinds.setdefault((notice.code, notice.acknowledged), []).append(notice)
        elif notice.severity == "warning":
            warnings.setdefault(f"{notice.code} {notice.text}", notice)
    return {
        "warnings": tuple(warnings.values()),
        "acknowledged": tuple((each[0], len(each)) for each in kinds.values()),
        "not_assessed": _not_assessed(unnamed),
    }


def _not_assessed(notices: Iterable[Notice]) -> tuple[str, ...]:
    """Return the influences not included in U, one of texts that differ in numbers."""
    found: dict[str, str] = {}
    for notice in notices:
        if _is_outside(notice):
            text = _influence(notice)
            found.setdefault(re.sub(r"[\d.]+", "#", text), text)
    return tuple(found.values())


def _influence(notice: Notice) -> str:
    """Return the name of an influence, a sentence if it has none."""
    named = MISSING.match(notice.text) if notice.code else None
    effect = LEFT_OUT.search(notice.effect)
    if not named and not effect:
        return f"{notice.text} {notice.effect}".strip()
    text = named[1] if named else notice.text.rstrip(".")
    text = f"{effect[1]} ({text})" if effect else text
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]


def _is_outside(notice: Notice) -> bool:
    """Whether a notice states an effect that neither U nor its coverage includes."""
    if not notice.code:
        return any(phrase in notice.text for phrase in NOT_IN_U_WITHOUT_CODE)
    stated = notice.code == MODEL_INFLUENCES_NOT_ASSESSED.code
    return notice.code in NOT_IN_U or (bool(notice.possible_size) and not stated)


def _conditions(form: Form, manifests: Sequence[Manifest]) -> Iterator[tuple[str, str, float, float]]:
    """Yield name, D-SI unit, smallest and largest value of the stated surroundings."""
    around, stated = [manifest.rig.surroundings for manifest in manifests], form.conditions
    for name, unit, values, factor in (
        ("Temperature of the air", r"\degreecelsius", stated.temperature or [e.temperature for e in around], 1.0),
        ("Temperature of the sensor", r"\degreecelsius", [e.sensor_temperature for e in around], 1.0),
        ("Relative humidity of the air", r"\percent", stated.humidity or [e.humidity for e in around], 100.0),
        ("Pressure of the air", r"\hecto\pascal", [e.pressure for e in around], 0.01),
    ):
        numbers = [factor * value for value in values if value is not None]
        if numbers:
            yield name, unit, min(numbers), max(numbers)


def _loads(manifests: Sequence[Manifest]) -> tuple[CertifiedLoad, ...]:
    """Return the different masses above the sensor with their recordings."""
    found: dict[tuple[CertifiedMass, ...], list[str]] = {}
    for manifest in manifests:
        load, sensor = manifest.rig.load, manifest.rig.sensor
        if load is not None and sensor is not None:
            stated = {
                item.key.removesuffix("_uncertainty"): item.stated.certificate
                for item in manifest.inputs
                if item.stated is not None
            }
            parts = [part for part in manifest.part if part.body == "load"]
            named = dict.fromkeys(stated.get(f"part.{part.name}.mass", "") for part in parts)
            u_parts = float(np.linalg.norm([part.mass_uncertainty for part in parts]))
            masses = (
                CertifiedMass("Load", load.true_mass, 2.0 * load.mass_uncertainty, stated.get("load.mass", "")),
                CertifiedMass(
                    "Further parts",
                    sum(part.true_mass for part in parts),
                    2.0 * u_parts,
                    ", ".join(filter(None, named)),
                ),
                CertifiedMass(
                    "Internal mass of the item",
                    sensor.internal_mass,
                    2.0 * sensor.internal_mass_uncertainty,
                    stated.get("sensor.internal_mass", ""),
                ),
            )
            found.setdefault(tuple(one for one in masses if one.mass_kg), []).append(manifest.folder.name)
    return tuple(CertifiedLoad(tuple(names), masses) for masses, names in found.items())


def _sources(inputs: Sequence[UncertainInput]) -> tuple[UnderlyingCertificate, ...]:
    """Return the certificates of the inputs, each once with its inputs."""
    named: dict[tuple[str, str, str], dict[str, None]] = {}
    for item in inputs:
        statement = item.stated
        if statement is not None and (statement.certificate or statement.laboratory):
            key = statement.certificate, statement.laboratory, str(statement.date or "")
            named.setdefault(key, {})[f"{item.file.name}: {item.key.removesuffix('_uncertainty')}"] = None
    return tuple(UnderlyingCertificate(tuple(keys), *about) for about, keys in named.items())
