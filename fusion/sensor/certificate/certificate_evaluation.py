"""Content of a certificate: results of recordings, and statements of the laboratory."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date as Date
from itertools import chain
from pathlib import Path
from typing import Literal

from fusion.base import count_text
from fusion.campaign.curve import CurvePoint
from fusion.campaign.joint_evaluation import best_points, curve_points, evaluate_campaign, main_channel
from fusion.campaign.recording_results import RecordingResults, SensorFacts, read_recorded
from fusion.errors import InputError
from fusion.estimation.coverage import COVERAGE, Polar
from fusion.phasors.phasor_notices import CAMERA_DELAYED, COARSE_ROWS, PERIODIC_JITTER, SHUTTER_NOT_CONVERGED
from fusion.recording.excitation import kinds_of
from fusion.recording.load import RECORDING_NAME, Manifest, find_recordings, load_manifest, select_kinds
from fusion.recording.toml import UncertainInput
from fusion.report.folder import hash_files, sha256
from fusion.report.table import has_phase
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_inputs import (
    CERTIFIED_COMMANDS,
    FORM_FILE,
    Conformity,
    Form,
    NumberList,
    find_command,
    find_results_folder,
    read_certified_numbers,
    read_form,
    read_results_origin,
    select_recordings,
)
from fusion.sensor.model_notices import MODEL_INFLUENCES_NOT_ASSESSED
from fusion.sensor.response_notices import COARSE_CONVERTER_STEPS
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.notices import Notice

Verdict = Literal["pass", "fail"]
SCOPE = (
    "The results relate only to the item calibrated, in the condition and under the conditions stated. This "
    "certificate may be reproduced in full only, unless the laboratory agrees in writing."
)
NOT_IN_U = {
    notice.code
    for notice in (CAMERA_DELAYED, COARSE_ROWS, SHUTTER_NOT_CONVERGED, PERIODIC_JITTER, COARSE_CONVERTER_STEPS)
}
"""Codes of warnings of an effect that U does not include."""
NOT_IN_U_WITHOUT_CODE = ("not assessed", "not in U")
"""Phrases of such notices in results of older versions, whose notices have no code."""
UNCERTAINTY = (
    f"U is the standard uncertainty times a coverage factor k for a probability of {100 * COVERAGE:g} %, after the GUM "
    "(JCGM 100, JCGM 102). It is based on the stated uncertainties of all inputs and valid under the assumptions of "
    "the evaluation: rigid bodies, linear instruments, loads only through the sensor. k is "
)


@dataclass(frozen=True)
class CertifiedValue:
    """One value of a certificate: frequency (Hz), measured value, and U.

    U of the magnitude and of the phase (rad). U is k·u with `k` and `k_phase` of the form, and at least the stated
    capability. `has_phase`: whether magnitude and phase are determined; otherwise only the complex value and its region
    are.
    """

    frequency_hz: float
    element: Polar
    expanded_magnitude: float
    expanded_phase_rad: float
    k: float
    k_phase: float
    has_phase: bool


@dataclass(frozen=True)
class CertifiedElement:
    """An element of the sensor's sensitivity over frequency: output `channel` per load `component`.

    Attributes
    ----------
    unit : of the output.
    kind : element, matrix, or ratio (output over load, without correction for other loads).
    main : whether the output belongs to the load.
    deviation, verdicts : of every value; empty without a limit or a static sensitivity.
    """

    channel: str
    component: str
    unit: str
    kind: str
    main: bool
    values: tuple[CertifiedValue, ...]
    deviation: tuple[tuple[float, float], ...] = ()
    verdicts: tuple[Verdict, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the result."""
        if self.kind == "ratio":
            return f"Ratio of output {self.channel} to driven load {self.component}"
        return f"Sensitivity {self.channel} per {self.component}"


@dataclass(frozen=True)
class UnderlyingCertificate:
    """An underlying certificate: the inputs that refer to it, its number, laboratory and date."""

    inputs: tuple[str, ...]
    certificate: str
    laboratory: str
    day: str


@dataclass(frozen=True, kw_only=True)
class CertificateContent:
    """What a certificate states of results.

    Attributes
    ----------
    elements, numbers : sensitivities, or lists of single numbers.
    warnings : of the evaluation, reviewed by the authoriser.
    not_assessed : influences not included in U.
    versions : of the software that computed the results.
    """

    title: str
    sensor: SensorFacts
    elements: tuple[CertifiedElement, ...] = ()
    numbers: tuple[NumberList, ...] = ()
    warnings: tuple[str, ...]
    not_assessed: tuple[str, ...]
    versions: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Certificate(CertificateContent):
    """All content of a certificate, for XML and page.

    `begin`, `end`: days of the calibration; `conditions`: name, D-SI unit, smallest and largest value.
    """

    form: Form
    rig_path: Path
    recordings: tuple[str, ...]
    begin: Date
    end: Date
    procedure: str
    conditions: tuple[tuple[str, str, float, float], ...]
    sources: tuple[UnderlyingCertificate, ...]

    def statements(self) -> Iterator[tuple[str, str]]:
        """Yield name and text of every statement."""
        administration, capability, limit = self.form.administration, self.form.laboratory.cmc, self.form.conformity
        yield "Scope", SCOPE
        yield (
            "Uncertainty",
            UNCERTAINTY + ("that of the effective degrees of freedom." if self.form.k == "effective" else "2."),
        )
        if self.elements and (capability.magnitude or capability.phase):
            sizes = f"{100 * capability.magnitude:g} % of the magnitude and {capability.phase:g} rad of the phase"
            yield "Capability", f"No U is stated below {sizes}."
        if self.sources:
            yield "Traceability", "To the SI through the certificates listed with the inputs that they were stated for."
        if administration.traceability:
            yield "Traceability", administration.traceability
        if self.elements and limit is not None:
            rule = "|deviation| + U" if limit.rule == "guarded" else "|deviation|"
            yield (
                "Decision rule",
                f"A main element conforms where {rule} of its magnitude from the static sensitivity is within "
                f"{100 * limit.tolerance:g} % (ILAC-G8:09/2019, {limit.rule} acceptance).",
            )
        if self.not_assessed:
            yield "Not included in U", " ".join(self.not_assessed)
        if self.warnings:
            count = count_text(len(self.warnings), "warning")
            yield "Warnings", f"The evaluation gave {count}, which {administration.authoriser} has reviewed."
        if administration.remarks:
            yield "Remarks", administration.remarks


def evaluate_certificate(
    path: Path, results: Path | None = None, form_path: Path | None = None, *, allow_outside: bool = False
) -> Certificate:
    """Collect the content of a certificate of a campaign or a recording.

    `results`: folder of results of `run`, `rotate`, `identify` or `step`, by default that of `find_results_folder`.
    `form_path`: certificate.toml, by default in the same folder. Raises `InputError`, with all mistakes of one kind,
    for missing or outdated results, empty keys, recordings without a date, expired certificates of inputs, and warnings
    that are not reviewed.
    """
    recordings = find_recordings(path)
    is_single = not path.is_dir() or (path / RECORDING_NAME).is_file()
    folder = recordings[0].parent if is_single else path
    top = find_results_folder(folder, results)
    command = find_command(top)
    if command is not None:
        recordings = select_recordings(recordings, top, command)
    elif not is_single:
        recordings = select_kinds(recordings, kinds_of("run"))
    form_path = folder / FORM_FILE if form_path is None else form_path
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in recordings]
    form = _named(read_form(form_path), manifests[0])
    _refuse_gaps(form, form_path, manifests)
    if command is None:
        folders = [top] if is_single else [top / manifest.folder.name for manifest in manifests]
        found = _sensitivities(folder.resolve().name, manifests, folders, top, form)
    else:
        found = _numbers(command, manifests, top, form)
    if found.warnings and not form.administration.warnings_reviewed:
        key, count = "administration.warnings_reviewed", len(found.warnings)
        raise InputError(declared.WARNINGS_NOT_REVIEWED, form_path, key, count=count, first=found.warnings[0])
    days = _days(form, manifests)
    return Certificate(
        **vars(found),
        form=form,
        rig_path=manifests[0].rig_path,
        recordings=tuple(manifest.name for manifest in manifests),
        begin=min(days),
        end=max(days),
        procedure=form.administration.procedure or ", ".join(sorted({m.procedure or "" for m in manifests} - {""})),
        conditions=tuple(_conditions(manifests)),
        sources=_sources([item for manifest in manifests for item in manifest.inputs]),
    )


def _sensitivities(
    name: str, manifests: Sequence[Manifest], folders: Sequence[Path], top: Path, form: Form
) -> CertificateContent:
    """Return the sensitivities of a campaign `name`, or of a recording, from results of `run`."""
    recorded = [_results_of(manifest, folder) for manifest, folder in zip(manifests, folders, strict=True)]
    evaluation = evaluate_campaign(name, recorded, {})
    sensor = evaluation.sensor
    if sensor is None:
        raise _no_sensor(manifests)
    points = curve_points(evaluation)
    mains = {
        component: sensor.channels[main_channel(evaluation, sensor.channels, index)]
        for index, component in enumerate(LOAD_COMPONENTS)
    }
    elements = tuple(_elements(points, mains, sensor.unit, form))
    if not elements:
        raise InputError(declared.NO_CERTIFIABLE_RESULT, top, expected="results with outputs over a driven load")
    ratios = all(element.kind == "ratio" for element in elements)
    return CertificateContent(
        title="Output over driven load" if ratios else "Dynamic sensitivity",
        sensor=sensor,
        elements=elements,
        warnings=tuple(dict.fromkeys(_warnings(recorded, evaluation.notices))),
        not_assessed=_not_assessed(chain(*(entry.joint_notices for entry in recorded), evaluation.notices)),
        versions=recorded[0].origin.versions,
    )


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
    warnings = [notice for notice in notices if notice.severity == "warning"]
    facts = SensorFacts(sensor.name, sensor.serial, sensor.channels, sensor.unit, sensor.sense, None, None, 0.0)
    return CertificateContent(
        title=CERTIFIED_COMMANDS[command].title,
        sensor=facts,
        numbers=read_certified_numbers(folder, command, k=None if form.k == "effective" else 2.0),
        warnings=tuple(dict.fromkeys(f"{n.where}: {n.text}" if n.where else n.text for n in warnings)),
        not_assessed=(*scopes, *_not_assessed(notices)),
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


def _refuse_gaps(form: Form, path: Path, manifests: Sequence[Manifest]) -> None:
    """Refuse missing entries, all in one error, and inputs with expired certificates."""
    gaps = list(form.missing())
    if not _days(form, manifests):
        gaps.append("administration.begun, or the date of every recording")
    if not form.administration.traceability and not any(_sources(m.inputs) for m in manifests):
        gaps.append("administration.traceability, or the certificate of an input in rig.toml or recording.toml")
    if not form.item.customer_number and not any(m.rig.sensor and m.rig.sensor.serial for m in manifests):
        gaps.append("item.customer_number, or the serial number of the sensor in rig.toml")
    if gaps:
        raise InputError(declared.MISSING_CERTIFICATE_ENTRIES, path, ", ".join(gaps))
    expired = [(manifest.path, notice) for manifest in manifests for notice in manifest.expiry_notices]
    if expired:
        inputs = dict.fromkeys(f"{notice.values['key']} ({notice.values['source']})" for _, notice in expired)
        raise InputError(declared.EXPIRED_CERTIFICATES, expired[0][0], inputs=", ".join(inputs))
    issued, last = form.administration.issued, max(_days(form, manifests))
    if issued is not None and issued < last:
        raise InputError(
            declared.ISSUED_BEFORE_CALIBRATION, path, "administration.issued", last=str(last), found=str(issued)
        )


def _days(form: Form, manifests: Sequence[Manifest]) -> list[Date]:
    """Return the days of the calibration, none if one recording has no date."""
    administration = form.administration
    if administration.begun is not None:
        return [administration.begun, administration.ended or administration.begun]
    days = [manifest.date for manifest in manifests if manifest.date is not None]
    return days if len(days) == len(manifests) else []


def _results_of(manifest: Manifest, folder: Path) -> RecordingResults:
    """Read the results of a recording, which must be those of its present files."""
    recorded = read_recorded(folder)
    now, then = hash_files(manifest.files, manifest.root, manifest.file_identities).hashes, recorded.origin.input_hashes
    if now != then:
        changed = min(name for name in {*now, *then} if now.get(name) != then.get(name))
        raise InputError(declared.OUTDATED_RESULTS, folder, expected=str(manifest.path), changed=changed, command="run")
    return recorded


def _elements(points: Sequence[CurvePoint], mains: dict[str, str], unit: str, form: Form) -> Iterator[CertifiedElement]:
    """Yield every element to be stated, the main ones first; of other outputs no ratios."""
    names = list(dict.fromkeys((point.channel, point.component) for point in points))
    for channel, component in sorted(names, key=lambda name: name[0] != mains[name[1]]):
        named = (channel, component)
        of_element = best_points([point for point in points if (point.channel, point.component) == named])
        main = mains[component] == channel
        if not main and of_element[0].kind == "ratio":
            continue
        values = tuple(_stated(point, form) for point in of_element)
        deviation, verdicts = _conformity(of_element, form.conformity) if main else ((), ())
        yield CertifiedElement(channel, component, unit, of_element[0].kind, main, values, deviation, verdicts)


def _stated(point: CurvePoint, form: Form) -> CertifiedValue:
    """Return a value with U = k·u, at capability the stated capability."""
    element, capability = point.element, form.laboratory.cmc
    k, k_phase = (element.k, element.k_phase) if form.k == "effective" else (2.0, 2.0)
    return CertifiedValue(
        frequency_hz=point.frequency_hz,
        element=element,
        expanded_magnitude=max(k * element.u_magnitude, capability.magnitude * element.magnitude),
        expanded_phase_rad=max(k_phase * element.u_phase_rad, capability.phase),
        k=k,
        k_phase=k_phase,
        has_phase=has_phase(element),
    )


def _conformity(
    points: Sequence[CurvePoint], limit: Conformity | None
) -> tuple[tuple[tuple[float, float], ...], tuple[Verdict, ...]]:
    """Return relative deviations from the static sensitivity with U, and their conformity.

    ISO/IEC 17025:2017, 7.8.6; ILAC-G8:09/2019: "simple" accepts up to the limit, "guarded" up to the limit less U.
    """
    if limit is None or any(point.relative is None for point in points):
        return (), ()
    found = [(p.relative.magnitude - 1.0, p.relative.expanded_magnitude) for p in points if p.relative is not None]
    guard = 1.0 if limit.rule == "guarded" else 0.0
    inside = [abs(value) + guard * expanded <= limit.tolerance for value, expanded in found]
    return tuple(found), tuple("pass" if good else "fail" for good in inside)


def _warnings(recorded: Iterable[RecordingResults], joint: Iterable[Notice]) -> Iterator[str]:
    """Yield the warnings of recordings and campaign."""
    for entry in recorded:
        yield from (f"{entry.name}: {notice.text}" for notice in entry.notices if notice.severity == "warning")
    yield from (notice.text for notice in joint if notice.severity == "warning")


def _not_assessed(notices: Iterable[Notice]) -> tuple[str, ...]:
    """Return the influences not included in U, one of texts that differ in numbers."""
    found: dict[str, str] = {}
    for notice in notices:
        if _is_outside(notice):
            text = f"{notice.text} {notice.effect}".strip()
            found.setdefault(re.sub(r"[\d.]+", "#", text), text)
    return tuple(found.values())


def _is_outside(notice: Notice) -> bool:
    """Whether a notice states an effect that neither U nor its coverage includes."""
    if not notice.code:
        return any(phrase in notice.text for phrase in NOT_IN_U_WITHOUT_CODE)
    stated = notice.code == MODEL_INFLUENCES_NOT_ASSESSED.code
    return notice.code in NOT_IN_U or (bool(notice.possible_size) and not stated)


def _conditions(manifests: Sequence[Manifest]) -> Iterator[tuple[str, str, float, float]]:
    """Yield name, D-SI unit, smallest and largest value of the stated surroundings."""
    around = [manifest.rig.surroundings for manifest in manifests]
    for name, unit, values, factor in (
        ("Temperature of the air", r"\degreecelsius", [e.temperature for e in around], 1.0),
        ("Temperature of the sensor", r"\degreecelsius", [e.sensor_temperature for e in around], 1.0),
        ("Relative humidity of the air", r"\percent", [e.humidity for e in around], 100.0),
        ("Pressure of the air", r"\hecto\pascal", [e.pressure for e in around], 0.01),
    ):
        stated = [factor * value for value in values if value is not None]
        if stated:
            yield name, unit, min(stated), max(stated)


def _sources(inputs: Sequence[UncertainInput]) -> tuple[UnderlyingCertificate, ...]:
    """Return the certificates of the inputs, each once with its inputs."""
    named: dict[tuple[str, str, str], dict[str, None]] = {}
    for item in inputs:
        statement = item.stated
        if statement is not None and (statement.certificate or statement.laboratory):
            key = statement.certificate, statement.laboratory, str(statement.date or "")
            named.setdefault(key, {})[f"{item.file.name}: {item.key.removesuffix('_uncertainty')}"] = None
    return tuple(UnderlyingCertificate(tuple(keys), *about) for about, keys in named.items())
