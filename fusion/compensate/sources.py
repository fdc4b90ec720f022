"""What is compensated: models of step responses, models over the load, or a frequency and a damping ratio."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fusion.compensate.wish import COMMAND
from fusion.errors import InputError
from fusion.load import LOAD_COMPONENTS, LOAD_UNITS
from fusion.load_series.model_file import MODEL_FILE, read_load_models
from fusion.models_file import MODELS_FILE, ModelEntry, read_models
from fusion.notices import Notice
from shaker.models.compensation.dynamics import SensorDynamics, loaded_dynamics, modal_dynamics
from shaker.models.load_series.model import LoadModel
from shaker.models.modal import ModalModel


@dataclass(frozen=True)
class Subject:
    """An output channel for a load component, in output `unit` per `load_unit`, with what is known of its dynamics.

    `model`: fitted to releases, over the load, or stated. `noise`: standard deviation of the output at
    `sample_rate_hz`, None where they are not known. `source`: in words.
    """

    channel: str
    component: str
    unit: str
    load_unit: str
    model: ModalModel | LoadModel | SensorDynamics
    source: str
    sample_rate_hz: float | None = None
    noise: float | None = None

    @property
    def name(self) -> str:
        """Channel, and the component where that is another."""
        return self.channel if self.component in (self.channel, "") else f"{self.channel} for {self.component}"

    @property
    def is_scheduled(self) -> bool:
        """Whether the filter depends on the load."""
        return isinstance(self.model, LoadModel)

    def load_text(self, load: float) -> str:
        """Return a load in g, of a moment in kg·m²."""
        return f"{1e3 * load:.4g} g" if self.load_unit == "N" else f"{load:.4g} kg·m²"

    def dynamics(self, load_mass: float | None, modes: int, real_poles: bool) -> SensorDynamics:
        """Return what a filter takes out of the sensor with a load."""
        if isinstance(self.model, LoadModel):
            return loaded_dynamics(self.model, load_mass or 0.0, modes=modes)
        if isinstance(self.model, ModalModel):
            return modal_dynamics(self.model, modes=modes, real_poles=real_poles)
        if modes != 1:
            raise ValueError(f"modes: expected 1 of a sensor stated by frequency and damping, found {modes}")
        return self.model


@dataclass(frozen=True)
class Sources:
    """All subjects with the files they come from, and what is to be said of them."""

    name: str
    subjects: tuple[Subject, ...]
    files: tuple[Path, ...]
    notices: tuple[Notice, ...] = ()


def read_sources(paths: Sequence[Path]) -> Sources:
    """Read models.json, load.json, or the one that a folder of results holds; of both in a folder load.json."""
    found = [_read(path) for path in paths]
    subjects = [subject for one in found for subject in one.subjects]
    names = [subject.name for subject in subjects]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        expected = "one model per channel; leave a file out"
        raise InputError(paths[-1], "", found=f"a second model of {twice}", expected=expected)
    files = tuple(file for one in found for file in one.files)
    return Sources(found[0].name, tuple(subjects), files, tuple(notice for one in found for notice in one.notices))


def stated(sensor: SensorDynamics) -> Sources:
    """Return a sensor that is stated by numbers."""
    told = f"stated: {sensor.frequency_hz[0]:g} Hz, ζ = {sensor.damping_ratio[0]:g}"
    return Sources("stated sensor", (Subject("sensor", "", "1", "1", sensor, told),), ())


def chosen(sources: Sources, channels: Sequence[str]) -> tuple[Subject, ...]:
    """Return the subjects of some channels, of all where none is named; unknown names raise `InputError`."""
    known = [subject.channel for subject in sources.subjects]
    for name in channels:
        if name not in known:
            raise InputError(COMMAND, "--channel", found=name, expected=f"one of {', '.join(dict.fromkeys(known))}")
    return tuple(subject for subject in sources.subjects if not channels or subject.channel in channels)


def _read(path: Path) -> Sources:
    """The subjects of one file or folder."""
    file = path
    if path.is_dir():
        file = next((path / name for name in (MODEL_FILE, MODELS_FILE) if (path / name).is_file()), path)
        if file == path:
            expected = f"{MODELS_FILE} of shakercal step or {MODEL_FILE} of shakercal load in it"
            raise InputError(path, "", found="none of them", expected=expected)
    return _of_loads(file) if _holds_loads(file) else _of_steps(file)


def _holds_loads(file: Path) -> bool:
    """Whether a file holds models over the load."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        models = content["models"]
        return bool(models) and "moving_mass" in models[0]
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (ValueError, KeyError, TypeError) as error:
        expected = "models as shakercal step or shakercal load writes them"
        raise InputError(file, "", found=f"something else ({error})", expected=expected) from error


def _of_steps(file: Path) -> Sources:
    """One subject per channel: its own component, or else the one it answers to most."""
    models = read_models(file)
    best: dict[str, ModelEntry] = {}
    for entry in models:
        before = best.get(entry.channel)
        own = entry.component == entry.channel
        more = before is None or abs(entry.model.static_gain) > abs(before.model.static_gain)
        if own or (more and (before is None or before.component != before.channel)):
            best[entry.channel] = entry
    subjects = [
        Subject(
            channel=entry.channel,
            component=entry.component,
            unit=entry.unit,
            load_unit=load_unit(entry.component),
            model=entry.model,
            source=f"{entry.method}, {entry.recording}",
            sample_rate_hz=entry.sample_rate_hz,
            noise=entry.noise,
        )
        for entry in best.values()
    ]
    if not subjects:
        raise InputError(file, "models", found="none", expected="at least one model")
    return Sources(models.name, tuple(subjects), (file,))


def _of_loads(file: Path) -> Sources:
    """One subject per component; of solutions that the data cannot tell apart the first, told in a notice."""
    subjects, notices = [], []
    for model in read_load_models(file):
        if model.solution > 1:
            continue
        if model.solutions > 1:
            text = (
                f"{model.solutions} solutions fit the records equally well; filters follow the first, and differ from "
                "the others with loads that were not measured"
            )
            notices.append(Notice("warning", text, model.channel))
        told = "two masses" if model.is_rigid else "three masses"
        subject = Subject(model.channel, model.component, model.unit, load_unit(model.component), model, told)
        loads = ", ".join(subject.load_text(load) for load in model.load_masses)
        subjects.append(replace(subject, source=f"{told}, fitted to loads of {loads}") if loads else subject)
    return Sources(file.parent.resolve().name, tuple(subjects), (file,), tuple(notices))


def load_unit(component: str) -> str:
    """Return N or N.m."""
    return dict(zip(LOAD_COMPONENTS, LOAD_UNITS, strict=True)).get(component, "N")
