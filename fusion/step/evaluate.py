"""From recordings of releases to models of a sensor's components."""

from __future__ import annotations

import time
from collections.abc import Sequence

from fusion.errors import ComputeError, InputError
from fusion.load import LOAD_COMPONENTS
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.provenance import versions
from fusion.step.component import evaluate_component
from fusion.step.fitting import Fitted, fit_component
from fusion.step.records import check_kind
from fusion.step.releases import read_recording
from fusion.step.result import ComponentResult, Release, StepEvaluation
from fusion.step.settings import StepSettings


def evaluate_steps(
    name: str, manifests: Sequence[Manifest], settings: StepSettings, input_hashes: dict[str, str]
) -> StepEvaluation:
    """Return what recordings of one sensor's releases tell: records → readings → models → indices.

    Raises `InputError` for what the user can mend in the files, `ComputeError` where no model is found at all.
    """
    started = time.monotonic()
    _check_together(manifests)
    releases, notices = _read(manifests)
    _check_forces(releases, settings)
    components: list[ComponentResult] = []
    for fitted in _fit(releases, settings):
        result, told = evaluate_component(fitted, settings)
        components.append(result)
        notices += told
    if all(result.pooled is None for result in components):
        why = next(notice for notice in notices if notice.severity == "warning")
        raise ComputeError(f"no model was found of any output ({why.where}: {why.text}); see docs/steps.md, limits")
    rig = manifests[0].rig
    return StepEvaluation(
        name=name,
        rig=rig.name,
        sensor=rig.sensor,
        components=tuple(components),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_settings(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _check_together(manifests: Sequence[Manifest]) -> None:
    """Recordings that are compared share a rig."""
    for manifest in manifests:
        check_kind(manifest)
        if manifest.rig_path.resolve() != manifests[0].rig_path.resolve():
            expected = f"{manifests[0].rig_path}, the rig of {manifests[0].folder.name}"
            raise InputError(manifest.path, "rig", found=str(manifest.rig_path), expected=expected)


def _read(manifests: Sequence[Manifest]) -> tuple[list[Release], list[Notice]]:
    """All releases; those of one component must drive the same output."""
    releases: list[Release] = []
    notices: list[Notice] = []
    for manifest in manifests:
        release, told = read_recording(manifest)
        notices += told
        component = release.input.record.component
        first = next((one for one in releases if one.input.record.component == component), release)
        if first.driven != release.driven:
            expected = f"{first.driven}, the output that {component} drives in {first.name}"
            raise InputError(manifest.path, "daq.channel", found=release.driven, expected=expected)
        releases.append(release)
    return releases, notices


def _fit(releases: Sequence[Release], settings: StepSettings) -> list[Fitted]:
    """The releases of every component fitted."""
    components = {release.input.record.component for release in releases}
    own = [[r for r in releases if r.input.record.component == c] for c in LOAD_COMPONENTS if c in components]
    return [fit_component(found, settings) for found in own]


def _check_forces(releases: Sequence[Release], settings: StepSettings) -> None:
    """A load that is to be taken as measured must have been measured."""
    for release in releases:
        if settings.release == "measured" and release.input.record.force is None:
            expected = "the name of the force channel, for --release measured"
            raise InputError(release.input.manifest.path, "excitation.force", found="nothing", expected=expected)
