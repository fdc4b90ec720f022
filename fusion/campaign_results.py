"""The joint files of a campaign: tables, curve, cross-talk, everything with its correlations, and the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fusion.results import merge_results


def write_campaign(top: Path, name: str, folders: Sequence[Path], failed: Mapping[str, str]) -> list[Path]:
    """Write the joint files of the campaign `name` into the folder `top` and return their paths.

    `folders`: results folders of the recordings that could be evaluated, in the order of the tables; everything is
    read from them. `failed`: folders of the others, by name, and why there is no result.
    """
    return merge_results(folders, top)
