"""The releases of a component fitted, and those that make its model brought to one structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fusion.notices import Notice
from fusion.step.choose import choose_releases, common_structure
from fusion.step.releases import fit_release, structure_of
from fusion.step.result import Release
from fusion.step.settings import StepSettings


@dataclass(frozen=True)
class Fitted:
    """The releases of one component with their models; `used`: names of those that make its model, for the `reason`.

    `notices`: what could not be fitted, or had to be fitted anew.
    """

    releases: tuple[Release, ...]
    used: tuple[str, ...]
    reason: str
    notices: tuple[Notice, ...]

    @property
    def chosen(self) -> tuple[Release, ...]:
        """The releases that make the model."""
        return tuple(release for release in self.releases if release.name in self.used)


def fit_component(releases: Sequence[Release], settings: StepSettings) -> Fitted:
    """Fit all releases of a component, and choose those that make its model."""
    found = [fit_release(release, settings) for release in releases]
    notices = tuple(notice for _, told in found for notice in told)
    chosen = choose_releases([release for release, _ in found])
    names = tuple(release.name for release in chosen.releases)
    fitted = Fitted(tuple(release for release, _ in found), names, chosen.reason, notices)
    wanted = common_structure(chosen.releases) if chosen.releases else (0, 0)
    return _of_structure(fitted, settings, wanted) if names else fitted


def _of_structure(fitted: Fitted, settings: StepSettings, wanted: tuple[int, int]) -> Fitted:
    """Fit those chosen releases anew whose models have another structure; what cannot be fitted so is left out."""
    found: dict[str, Release] = {}
    anew: list[str] = []
    notices: list[Notice] = []
    text = f"{_count(wanted[0], 'mode')} and {_count(wanted[1], 'real pole')}, as others show"
    for release in fitted.chosen:
        if release.fit is not None and structure_of(release.fit) == wanted:
            found[release.name] = release
            continue
        again, _ = fit_release(replace(release, fit=None), settings, wanted)
        if again.fit is not None and structure_of(again.fit) == wanted:
            found[release.name] = again
            anew.append(release.name)
        else:
            notices.append(Notice("warning", f"{release.driven}: left out, no model with {text}", release.name))
    if anew:
        notices.append(Notice("info", f"fitted anew with {text}", ", ".join(anew)))
    releases = tuple(found.get(release.name, release) for release in fitted.releases)
    return Fitted(releases, tuple(found), fitted.reason, (*fitted.notices, *notices))


def _count(number: int, what: str) -> str:
    """A number of things."""
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
