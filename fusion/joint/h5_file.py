"""campaign.h5: what the recordings of a campaign say together, every covariance and every correlation written out."""

from __future__ import annotations

import io
from collections.abc import Sequence

import h5py

from fusion.joint.evaluation import CampaignEvaluation
from fusion.provenance import Provenance, write_provenance
from fusion.read_results import Recorded
from fusion.results_h5 import FORMAT, write_fields, write_value

JOINT_FIELDS = ("curves", "repeats", "linearity", "matrices", "cross_talks", "notices")


def campaign_h5(evaluation: CampaignEvaluation, files: Sequence[str]) -> bytes:
    """Return the content of campaign.h5; `files` are the names of all joint files. Equal input gives equal bytes."""
    stream = io.BytesIO()
    with h5py.File(stream, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["campaign"] = evaluation.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, campaign_origin(evaluation.recorded, files))
        _write_recordings(file.create_group("recordings"), evaluation)
        if evaluation.sensor is not None:
            write_fields(file.create_group("sensor", track_order=True), evaluation.sensor)
        for name in JOINT_FIELDS:
            write_value(file, name, getattr(evaluation, name))
    return stream.getvalue()


def campaign_origin(recorded: Sequence[Recorded], files: Sequence[str]) -> Provenance:
    """Return the inputs of all recordings, with the settings and versions that the first was evaluated with."""
    hashes: dict[str, str] = {}
    for entry in recorded:
        for name, digest in entry.origin.input_hashes.items():
            hashes[name if hashes.get(name, digest) == digest else f"{entry.folder}: {name}"] = digest
    first = recorded[0].origin if recorded else Provenance({}, {}, {}, ())
    return Provenance(dict(sorted(hashes.items())), first.settings, first.versions, tuple(files))


def _write_recordings(group: h5py.Group, evaluation: CampaignEvaluation) -> None:
    """Write which recordings there are, and which failed."""
    recorded = evaluation.recorded
    for name in ("folder", "name", "mounting", "rig", "kind"):
        write_value(group, name, [getattr(entry, name) for entry in recorded])
    write_value(group, "failed", list(evaluation.failed))
    write_value(group, "reason", list(evaluation.failed.values()))
