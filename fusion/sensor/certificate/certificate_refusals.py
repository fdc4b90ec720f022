"""Reasons that refuse a certificate, all of them in one error."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import date as Date
from pathlib import Path

from fusion.errors import InputError
from fusion.recording.load import Manifest
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_form import Form
from shakercal._common.notices import Notice

DRAFTED_SENSOR = "sensor under test"
"""Name that `shakercal init` gives a sensor of unknown name."""


def refusals(form: Form | None, path: Path, manifests: Sequence[Manifest], *, specimen: bool) -> Iterator[InputError]:
    """Yield every reason in form and manifests that refuses a certificate.

    `form`: None if it cannot be read. `path`: of certificate.toml. `specimen`: whether simulated recordings are
    accepted.
    """
    simulated = [manifest for manifest in manifests if manifest.simulated]
    if simulated and not specimen:
        first, count = simulated[0], len(simulated)
        yield InputError(declared.SIMULATED_RECORDINGS, first.path, count=count, total=len(manifests))
    elif specimen and not simulated:
        yield InputError(declared.NOT_A_SPECIMEN, manifests[0].path)
    sensor = manifests[0].rig.sensor
    if sensor is not None and sensor.name == DRAFTED_SENSOR:
        yield InputError(declared.UNNAMED_SENSOR, manifests[0].rig_path, "sensor.name", found=sensor.name)
    days = [] if form is None else calibration_days(form, manifests)
    if form is not None:
        yield from _gaps(form, path, manifests)
    if form is not None and days:
        yield from _wrong_days(form, path, days)
    yield from _expired(form, path, manifests, max(days, default=Date.today()))


def _gaps(form: Form, path: Path, manifests: Sequence[Manifest]) -> Iterator[InputError]:
    """Yield the missing entries, all in one error."""
    gaps = list(form.missing())
    if not calibration_days(form, manifests):
        gaps.append("administration.begun, or the date of every recording")
    if not form.item.customer_number and not any(m.rig.sensor and m.rig.sensor.serial for m in manifests):
        gaps.append("item.customer_number, or the serial number of the sensor in rig.toml")
    for name in ("temperature", "humidity"):
        if getattr(form.conditions, name) is None and any(
            getattr(manifest.rig.surroundings, name) is None for manifest in manifests
        ):
            gaps.append(f"conditions.{name}, or environment.{name} in rig.toml")
    if gaps:
        yield InputError(declared.MISSING_CERTIFICATE_ENTRIES, path, ", ".join(gaps))


def _wrong_days(form: Form, path: Path, days: Sequence[Date]) -> Iterator[InputError]:
    """Yield days of receipt and issue that contradict those of the calibration."""
    issued, received = form.administration.issued, form.administration.received
    if received is not None and received > min(days):
        yield InputError(
            declared.RECEIVED_AFTER_CALIBRATION,
            path,
            "administration.received",
            first=str(min(days)),
            found=str(received),
        )
    if issued is not None and issued < max(days):
        yield InputError(
            declared.ISSUED_BEFORE_CALIBRATION, path, "administration.issued", last=str(max(days)), found=str(issued)
        )


def _expired(form: Form | None, path: Path, manifests: Sequence[Manifest], last: Date) -> Iterator[InputError]:
    """Yield inputs and equipment whose certificates were not valid at the calibration."""
    inputs = dict[str, Path]()
    for manifest in manifests:
        day = manifest.date or last
        for item in manifest.inputs:
            if item.stated is not None and (item.stated.valid_until or day) < day:
                inputs.setdefault(f"{item.key.removesuffix('_uncertainty')} ({item.source})", manifest.path)
    if inputs:
        yield InputError(declared.EXPIRED_CERTIFICATES, next(iter(inputs.values())), inputs=", ".join(inputs))
    old = [one for one in (form.equipment if form else ()) if one.valid_until is not None and one.valid_until < last]
    if old:
        named = ", ".join(f"{one.name} ({one.certificate}, valid until {one.valid_until})" for one in old)
        yield InputError(declared.EXPIRED_CERTIFICATES, path, "equipment", inputs=named)


def unacknowledged(warnings: Sequence[Notice], path: Path) -> Iterator[InputError]:
    """Yield the error of warnings that nobody acknowledged, by code."""
    counts = Counter(notice.code or "without code" for notice in warnings)
    if counts:
        codes = ", ".join(f"{code} ({count})" if count > 1 else code for code, count in counts.items())
        yield InputError(
            declared.WARNINGS_NOT_REVIEWED, path, "acknowledged",
            count=len(warnings), codes=codes, first=f"{warnings[0].where}: {warnings[0].text}",
        )  # fmt: skip


def refusal_of(problems: Sequence[InputError], path: Path) -> InputError:
    """Return several reasons as one error that lists all of them."""
    if len(problems) == 1:
        return problems[0]
    listed = "; ".join(f"({number}) {problem}".rstrip(".") for number, problem in enumerate(problems, 1))
    return InputError(declared.CERTIFICATE_REFUSED, path, count=len(problems), problems=listed)


def calibration_days(form: Form, manifests: Sequence[Manifest]) -> list[Date]:
    """Return the days of the calibration, none if one recording has no date."""
    administration = form.administration
    if administration.begun is not None:
        return [administration.begun, administration.ended or administration.begun]
    days = [manifest.date for manifest in manifests if manifest.date is not None]
    return days if len(days) == len(manifests) else []
