"""Which figures the report of one recording holds."""

from __future__ import annotations

import numpy as np

from fusion.evaluation import Evaluation
from fusion.highlights import LOAD_COMPONENTS, driven_channel, driven_component, driven_element, main_line
from fusion.plots.acceleration import acceleration_pictures
from fusion.plots.motion import motion_pictures, subset_pictures
from fusion.plots.points import point_pictures
from fusion.plots.sensitivity import draw_budget, sensitivity_pictures
from fusion.plots.signals import channel_pictures, trigger_pictures
from fusion.plots.style import Picture


def draw_all(evaluation: Evaluation) -> dict[str, list[Picture]]:
    """All figures of a recording, by the section of the report that shows them."""
    return {
        "sensitivity": sensitivity_pictures(evaluation),
        "acceleration": acceleration_pictures(evaluation),
        "points": point_pictures(evaluation),
        "budget": budget_pictures(evaluation),
        "motion": [picture for stereo in evaluation.stereo for picture in motion_pictures(stereo)],
        "subsets": subset_pictures(evaluation),
        "channels": channel_pictures(evaluation),
        "trigger": trigger_pictures(evaluation),
    }


def budget_pictures(evaluation: Evaluation) -> list[Picture]:
    """The budget of the driven sensitivity at the strongest line, where there is one."""
    found = evaluation.sensitivity
    if found is None:
        return []
    line, channel, component = main_line(evaluation), driven_channel(evaluation), driven_component(evaluation)
    element = driven_element(evaluation)
    u_relative = np.array([entry.u_relative[line, element] for entry in found.budget])
    if not np.isfinite(u_relative).all() or not u_relative.any():
        return []
    frequency = found.frequency_hz[line]
    what = (
        f"the magnitude of output {found.channels[channel]} per load {LOAD_COMPONENTS[component]}, {frequency:.4f} Hz"
    )
    labels, types = [entry.label for entry in found.budget], [entry.type for entry in found.budget]
    return [draw_budget(labels, types, u_relative, what)]
