"""The command `shakercal identify`: a campaign → the sensor's stiffness, damping, masses and chain, result folder."""

from __future__ import annotations

import logging
from pathlib import Path

from fusion.evaluated import log_notices
from fusion.execution.threads import one_blas_thread
from fusion.identify.campaign import read_campaign
from fusion.identify.evaluate import evaluate_campaign
from fusion.identify.page import PAGE_FILE
from fusion.identify.results import H5_FILE, write_identification
from fusion.identify.settings import IdentifySettings
from fusion.identify.tables import printed
from fusion.provenance import check_folder

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "identify"


def run_identify(
    path: Path, output: Path | None, settings: IdentifySettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Identify the sensor of a campaign folder, write the results to `output` (default CAMPAIGN/identify), and print.

    A place that cannot take the results is refused before anything is computed.
    """
    campaign = read_campaign(path, allow_outside=allow_outside)
    folder = campaign.folder / DEFAULT_FOLDER if output is None else output
    check_folder(folder, campaign.input_hashes, force=force, marker=H5_FILE)
    with one_blas_thread():
        evaluation = evaluate_campaign(campaign, settings)
    log_notices(evaluation, log)
    write_identification(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
