"""Poles of releases in data files, without manifests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.base import PERCENT
from fusion.errors import ComputeError, InputError, as_input_error
from fusion.report.folder import command_json
from fusion.report.terminal import AS_JSON, log_notices, print_text
from fusion.sensor import model_notices as declared
from fusion.sensor.step.step_records import StepSettings
from fusion.sensor.step.step_releases import FAILURES
from shaker.io import read_channels
from shaker.release.record_file import step_record
from shaker.release.step_fit import StepFit, fit_step
from shakercal._common.digits import quantity_text
from shakercal._common.notices import Notice

COVERAGE = 2.0  # coverage factor of U: the noise of thousands of samples has many degrees of freedom


class PoleValue(NamedTuple):
    """A pole of a channel, with U; real poles have damping ratio 1."""

    file: str
    channel: str
    frequency_hz: float
    U_frequency_hz: float
    damping_ratio: float
    U_damping_ratio: float

    @property
    def text(self) -> str:
        """The pole as a line of the terminal."""
        frequency = quantity_text(self.frequency_hz, self.U_frequency_hz, "Hz")
        if self.damping_ratio == 1.0:
            return f"{self.channel}: real pole {frequency}"
        damping = quantity_text(PERCENT * self.damping_ratio, PERCENT * self.U_damping_ratio, "%")
        return f"{self.channel}: f_n {frequency}, damping ratio {damping}"


def is_data_file(path: Path) -> bool:
    """Whether a path is a file of channels, possibly missing; not a manifest or folder."""
    return path.suffix.lower() not in ("", ".toml") and not path.is_dir()


def fitted_poles(file: str, fit: StepFit) -> Iterator[PoleValue]:
    """Yield the modes by frequency, then the real poles that the record determines."""
    model = fit.model
    if model is None or model.covariance is None:
        return
    U = dict(zip(model.names, map(float, COVERAGE * np.sqrt(np.diag(model.covariance))), strict=True))
    for m in np.argsort(model.frequency_hz):
        hertz, damping = float(model.frequency_hz[m]), float(model.damping_ratio[m])
        yield PoleValue(file, fit.channel, hertz, U[f"frequency_hz_{m + 1}"], damping, U[f"damping_ratio_{m + 1}"])
    for q, hertz in enumerate(map(float, model.real_hz), 1):
        if U[f"real_hz_{q}"] < abs(hertz):
            yield PoleValue(file, fit.channel, hertz, U[f"real_hz_{q}"], 1.0, 0.0)


def print_poles(paths: Sequence[Path], settings: StepSettings) -> None:
    """Fit every channel of data files and print the poles with U; write no files.

    Raises `InputError` for a file that cannot be read, and `ComputeError` if no channel of a file shows a release.
    """
    if settings.method == "all":
        raise InputError(declared.POLES_BY_ONE_METHOD, paths[0], "--method", found="all", expected="pencil or arx")
    release = None if settings.release == "auto" else settings.release
    poles, notices = list[PoleValue](), list[Notice]()
    for path in paths:
        reasons, before = list[str](), len(poles)
        with as_input_error(path):
            records = [step_record(path, name, raw) for name, raw in read_channels(path).items()]
        for record in records:
            (channel,) = record.channels
            try:
                fit = fit_step(
                    record,
                    channel,
                    modes=settings.modes,
                    real_poles=settings.real_poles,
                    method=settings.method,
                    release=release,
                )
            except FAILURES as error:
                reasons.append(f"{channel}: {error}")
                continue
            poles += fitted_poles(str(path), fit)
            notices += fit.notices
        if len(poles) == before:
            raise ComputeError(
                declared.NO_STEP_MODEL, recording=str(path), reason=reasons[0] if reasons else "no channel"
            )
    if AS_JSON.get():
        shown = [pole._asdict() for pole in poles]
        print(command_json("step", poles=shown, notices=[notice.as_dict() for notice in notices], files=[]))
        return
    for path in paths:
        print_text(path.name)
        for pole in poles:
            if pole.file == str(path):
                print_text(pole.text)
    log_notices((notice, "") for notice in notices)
