"""What refuses a certificate: every wrong statement of certificate.toml, and all of them in one list."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from certificates import FORM
from support import RefusedCommand, edit, without_pages

from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.report.folder import hash_files
from fusion.report.recording_report import write_results
from fusion.sensitivity.analyse import Evaluation
from fusion.sensor import result_notices as raised
from fusion.sensor.certificate.certificate_content import SPECIMEN
from fusion.sensor.certificate.certificate_refusals import DRAFTED_SENSOR

MISSING = raised.MISSING_CERTIFICATE_ENTRIES.code
EXPIRED = raised.EXPIRED_CERTIFICATES.code
LATE = raised.RECEIVED_AFTER_CALIBRATION.code
EARLY = raised.ISSUED_BEFORE_CALIBRATION.code
WRONG = (
    ('number = "2026-0815"', 'number = ""', MISSING, "administration.number"),
    ("issued = 2026-11-23", 'issued = ""', MISSING, "administration.issued"),
    ("received = 2026-11-15", 'received = ""', MISSING, "administration.received"),
    ('operator = "Æsa 王"', 'operator = ""', MISSING, "administration.operator"),
    ('authoriser = "B. Leader"', 'authoriser = ""', MISSING, "administration.authoriser"),
    ('method = "Sinusoidal calibration on a shaker"', "", MISSING, "administration.method"),
    ("begun = 2026-11-19", "", MISSING, "administration.begun"),
    ("begun = 2026-11-19", 'begun = ""', MISSING, "administration.begun"),
    ('name = "Example & Co"', "", MISSING, "customer.name"),
    ('city = "Oslo"', "", MISSING, "customer.city"),
    ('country = "NO"', "", MISSING, "customer.country"),
    ('manufacturer = "Maker"', "", MISSING, "item.manufacturer"),
    ('condition = "without visible damage"', "", MISSING, "item.condition"),
    ('axes = "z out of the flange of the load"', "", MISSING, "item.axes"),
    ('supply = "5 V, 225 Hz"', "", MISSING, "amplifier.supply"),
    ('torque = "10 N m"', "", MISSING, "mounting.torque"),
    ("humidity = [0.40, 0.46]", "", MISSING, "conditions.humidity"),
    ('use = "reference"', 'use = "measuring"', MISSING, 'use = "reference"'),
    ('certificate = "V-3"', "", MISSING, "equipment[2].certificate"),
    ("valid_until = 2028-02-02", "valid_until = 2026-02-02", EXPIRED, "V-3, valid until 2026-02-02"),
    ("received = 2026-11-15", "received = 2026-11-20", LATE, "administration.received"),
    ("issued = 2026-11-23", "issued = 2026-11-19", EARLY, "administration.issued"),
    ("issued = 2026-11-23", 'issued = "23 November"', "", "administration.issued"),
    ("issued = 2026-11-23", "issued = 20261123", "", "administration.issued"),
    ('country = "NO"', 'country = "Norway"', "", "customer.country"),
    ("ended = 2026-11-20", "ended = 2026-11-18", "", "administration.ended"),
    ("temperature = [22.8, 23.3]", "temperature = [23.3, 22.8]", "", "conditions.temperature"),
    ("temperature = [22.8, 23.3]", "temperature = 23.0", "", "conditions.temperature"),
    ('use = "reference"', 'use = "good"', "", "use"),
    ("format = 1", "format = 1\nk = 3", "", "k"),
    ('axes = "z', 'axis = "z', "", "item.axis"),
    ("tolerance = 0.02", 'tolerance = 0.02\nrule = "kind"', "", "conformity.rule"),
)


@pytest.fixture(scope="module")
def demo(demo_recording: Path, demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with its results, and as many recordings as it has."""
    folder = tmp_path_factory.mktemp("refusals") / "demo"
    shutil.copytree(demo_recording, folder)
    manifest = load_manifest(folder / "Fz-0080")
    hashes = hash_files(manifest.files, manifest.root).hashes
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        write_results(replace(demo_evaluation, input_hashes=hashes), folder / "results" / "Fz-0080")
    return folder


def test_every_wrong_form_is_one_list(demo: Path, refused: RefusedCommand) -> None:
    """Each of them names its key, next to the recordings, which are simulated. What is missing is refused together."""
    assert len(WRONG) >= 30
    missing = {wrong[3]: wrong for wrong in WRONG if wrong[2] == MISSING}
    for several in (tuple(missing.values()), *((wrong,) for wrong in WRONG if wrong not in missing.values())):
        form = FORM
        for old, new, _, _ in several:
            assert old in form, old
            form = form.replace(old, new, 1)
        (demo / "certificate.toml").write_text(form, encoding="utf-8")
        refusal = refused("certificate", demo)
        assert raised.CERTIFICATE_REFUSED.code in refusal, several
        assert raised.SIMULATED_RECORDINGS.code in refusal
        assert all(f"{code} " in refusal and key in refusal for _, _, code, key in several), (several, refusal)
    assert not (demo / "certificate").exists()


def test_all_reasons_are_in_one_list(demo: Path, refused: RefusedCommand, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(demo, tmp_path / "demo"))
    edit(folder / "rig.toml", 'name = "six-axis wrist sensor"', f'name = "{DRAFTED_SENSOR}"')
    stated = 'mass = { value = 2.4063, U = 0.0004, k = 2, certificate = "M-1", valid_until = 2020-01-01 }'
    edit(folder / "rig.toml", "mass = 2.4063\nmass_uncertainty = 0.0002", stated)
    text = FORM.replace("received = 2026-11-15", "received = 2026-11-25").replace(
        "issued = 2026-11-23", "issued = 2026-11-01"
    )
    (folder / "certificate.toml").write_text(text.replace('torque = "10 N m"', ""), encoding="utf-8")
    refusal = refused("certificate", folder)
    declared = (
        raised.SIMULATED_RECORDINGS,
        raised.UNNAMED_SENSOR,
        raised.MISSING_CERTIFICATE_ENTRIES,
        raised.RECEIVED_AFTER_CALIBRATION,
        raised.ISSUED_BEFORE_CALIBRATION,
        raised.EXPIRED_CERTIFICATES,
        raised.OUTDATED_RESULTS,
    )
    for number, notice in enumerate(declared, 1):
        assert f"({number}) {notice.code} " in refusal


def test_simulated_recordings_give_a_specimen_only(demo: Path, refused: RefusedCommand, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(demo, tmp_path / "demo"))
    (folder / "certificate.toml").write_text(FORM, encoding="utf-8")
    assert raised.SIMULATED_RECORDINGS.code in refused("certificate", folder)
    assert main(["certificate", str(folder), "--specimen"]) == 0
    page = (folder / "certificate" / "certificate.html").read_text(encoding="utf-8")
    assert f"<span>{SPECIMEN}</span>" in page
    xml = (folder / "certificate" / "certificate.xml").read_text(encoding="utf-8")
    assert f"<dcc:uniqueIdentifier>{SPECIMEN} 2026-0815<" in xml
    assert "no item was calibrated" in xml
    shutil.rmtree(folder / "certificate")
    (folder / "Fz-0080" / "truth.json").unlink()
    assert raised.SIMULATED_RECORDINGS.code in refused("certificate", folder)  # by its name
    edit(folder / "Fz-0080" / "recording.toml", ", simulated", "")
    edit(folder / "Fz-0080" / "recording.toml", "simulated = true\n", "")
    assert raised.NOT_A_SPECIMEN.code in refused("certificate", folder, "--specimen")
