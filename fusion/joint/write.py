"""The joint files of a campaign: tables, curves, cross-talk, everything with its correlations, and the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fusion.joint.csv_files import campaign_tables
from fusion.joint.evaluation import evaluate_campaign
from fusion.joint.h5_file import campaign_h5
from fusion.joint.page import render_campaign
from fusion.output import write_whole
from fusion.read_results import read_recorded
from fusion.report import REPORT_FILE
from fusion.results import CAMPAIGN_FILE


def write_campaign(top: Path, name: str, folders: Sequence[Path], failed: Mapping[str, str]) -> list[Path]:
    """Write the joint files of the campaign `name` into the folder `top` and return their paths.

    `folders`: results folders of the recordings that could be evaluated, in the order of the tables; everything is
    read from them, so that equal results give equal files. `failed`: folders of the others, by name, and why there is
    no result. Every file is written whole; the HDF5 file, which says that all are there, comes last.
    """
    evaluation = evaluate_campaign(name, [read_recorded(folder) for folder in folders], failed)
    files: dict[str, str | bytes] = {**campaign_tables(evaluation, folders)}
    files[REPORT_FILE] = render_campaign(evaluation)
    files[CAMPAIGN_FILE] = campaign_h5(evaluation, [*files, CAMPAIGN_FILE])
    top.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        write_whole(top / file, content)
    return [top / file for file in files]
