"""Who signed what of a certificate: content, key, page; with signatures made by signxml."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path
from typing import Any

import pytest
from certificates import SIGNED
from support import RefusedCommand

from fusion.cli import main
from fusion.recording import recording_notices as read
from fusion.sensor import result_notices as raised
from fusion.sensor.certificate.certificate_xml import PAGE_HASH

UNSIGNED = SIGNED.partition("<Signature ")[0] + "</dcc:digitalCalibrationCertificate>\n"


@pytest.fixture
def unsigned(tmp_path: Path) -> Path:
    """A certificate without signature."""
    (tmp_path / "certificate.xml").write_text(UNSIGNED, encoding="utf-8")
    return tmp_path / "certificate.xml"


@pytest.fixture
def signed(unsigned: Path) -> Path:
    """The certificate with an XAdES signature of a laboratory's seal."""
    xades = pytest.importorskip("signxml.xades")
    from lxml import etree

    key, seal = sealed(pytest.importorskip("cryptography.x509"))
    signer = xades.XAdESSigner(c14n_algorithm="http://www.w3.org/2006/12/xml-c14n11")
    root = signer.sign(etree.parse(str(unsigned)).getroot(), key=key, cert=[seal])
    unsigned.write_bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8"))
    return unsigned


def sealed(x509: Any) -> tuple[Any, Any]:
    """A key with its X.509 certificate."""
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import rsa

    key = rsa.generate_private_key(65537, 2048)
    name = x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, "Seal of the laboratory")])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(7).not_valid_before(datetime.datetime(2026, 1, 1))
    return key, builder.not_valid_after(datetime.datetime(2030, 1, 1)).sign(key, hashes.SHA256())


def test_the_signer_is_named_and_what_is_not_checked(signed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certificate", "--verify", str(signed)]) == 0
    printed = capsys.readouterr().out
    assert "certificate Süd & 7" in printed
    assert "the key of CN=Seal of the laboratory" in printed
    assert "valid from 2026-01-01 to 2030-01-01" in printed
    assert "not checked: whether this X.509 certificate belongs to the laboratory" in printed


def test_another_key_and_changed_content_are_refused(signed: Path, refused: RefusedCommand) -> None:
    text = signed.read_text(encoding="utf-8")
    value = text.partition("SignatureValue>")[2].partition("<")[0]
    forged = value[:4] + ("B" if value[4] == "A" else "A") + value[5:]
    signed.write_text(text.replace(value, forged), encoding="utf-8")
    assert f"{raised.WRONG_SIGNATURE.code} " in refused("certificate", "--verify", signed)
    signed.write_text(text.replace("load mass", "Load mass"), encoding="utf-8")
    assert f"{read.CERTIFICATE_CHANGED.code} " in refused("certificate", "--verify", signed)


def test_without_the_library_the_content_alone_is_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "signxml", None)
    file = tmp_path / "certificate.xml"
    file.write_text(SIGNED, encoding="utf-8")
    assert main(["certificate", "--verify", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "content: " in printed
    assert "signxml is not installed" in printed


def test_an_unsigned_certificate_and_its_page(
    unsigned: Path, capsys: pytest.CaptureFixture[str], refused: RefusedCommand
) -> None:
    page = unsigned.with_name("certificate.html")
    page.write_bytes(b"abc")
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-4, example of SHA-256
    unsigned.write_text(UNSIGNED.replace("load mass", f"{PAGE_HASH}{digest}"), encoding="utf-8")
    assert main(["certificate", "--verify", str(unsigned)]) == 0
    printed = capsys.readouterr().out
    assert "not signed" in printed
    assert "is the one that was certified" in printed
    page.write_bytes(b"abd")
    assert f"{raised.OTHER_PAGE.code} " in refused("certificate", "--verify", unsigned)
