"""Verification of a certificate's file: content, signer, page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date as Date
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

from fusion.errors import InputError
from fusion.recording.dcc import read_dcc
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_xml import PAGE_FILE, PAGE_HASH

NOT_CHECKED = (
    "whether this X.509 certificate belongs to the laboratory, its chain of issuers, its revocation, and the time of "
    "signing"
)
"""Properties of a signature that this program does not check."""


class NoSignatureLibrary(Exception):
    """`signxml` is not installed."""


class InvalidSigner(Exception):
    """The signature does not belong to the key that it states."""


@dataclass(frozen=True)
class Signer:
    """Subject and issuer of an X.509 certificate whose key made a signature, and its validity."""

    subject: str
    issuer: str
    valid_from: Date
    valid_until: Date


def verify_signer(path: Path) -> Signer:
    """Return the signer of a file with one signature of that key.

    Raises `NoSignatureLibrary`; `InvalidSigner` if the value is of another key; `ValueError` with the reason if it
    cannot be checked.
    """
    try:
        signxml, x509 = import_module("signxml"), import_module("cryptography.x509")
        exceptions = import_module("signxml.exceptions")
    except ImportError as error:
        raise NoSignatureLibrary from error
    from lxml import etree

    text = path.read_bytes()
    found = etree.fromstring(text).findall("{http://www.w3.org/2000/09/xmldsig#}Signature")
    if len(found) != 1:
        raise ValueError(f"the file has {len(found)} signatures at its root")
    stated = found[0].findtext(".//{http://www.w3.org/2000/09/xmldsig#}X509Certificate")
    if not stated:
        raise ValueError("the signature includes no X.509 certificate")
    pem = "\n".join(("-----BEGIN CERTIFICATE-----", stated.strip(), "-----END CERTIFICATE-----"))
    owner: Any = x509.load_pem_x509_certificate(pem.encode())
    config = signxml.SignatureConfiguration(location="./", expect_references=False)
    try:
        signxml.XMLVerifier().verify(text, x509_cert=owner, expect_config=config)
    except exceptions.InvalidSignature as error:
        raise InvalidSigner(str(error)) from error
    except exceptions.InvalidInput as error:
        raise ValueError(str(error)) from error
    return Signer(
        owner.subject.rfc4514_string(),
        owner.issuer.rfc4514_string(),
        owner.not_valid_before_utc.date(),
        owner.not_valid_after_utc.date(),
    )


def verify_certificate(path: Path) -> None:
    """Print who signed what of a certificate, and what was not checked.

    Raises `InputError` for changed content, another key, or another page.
    """
    certificate = read_dcc(path)
    origin = ", ".join(filter(None, (certificate.laboratory, str(certificate.date or ""))))
    found = [*_signature(path, [notice.text for notice in certificate.signature_notices]), *_page(path)]
    print("\n".join([f"{path}: certificate {certificate.number} of {origin}", *found]))


def _signature(path: Path, notices: list[str]) -> Iterator[str]:
    """Yield the state of content and signer."""
    if not notices:
        yield "not signed: neither a change of its content nor its author would be noticed"
        return
    yield from (f"content: {text}" for text in notices)
    try:
        signer = verify_signer(path)
    except NoSignatureLibrary:
        yield f"signer: not checked, since signxml is not installed. Not checked either: {NOT_CHECKED}."
    except InvalidSigner as error:
        raise InputError(declared.WRONG_SIGNATURE, path, "ds:Signature", reason=str(error) or "no reason") from error
    except ValueError as error:
        yield f"signer: not checked ({error}). Not checked either: {NOT_CHECKED}."
    else:
        days = f"valid from {signer.valid_from} to {signer.valid_until}"
        yield f"signer: the key of {signer.subject} (X.509 certificate by {signer.issuer}, {days})"
        yield f"not checked: {NOT_CHECKED}"


def _page(path: Path) -> Iterator[str]:
    """Yield whether the page next to the file is the one whose hash it states."""
    stated = re.search(rf"{re.escape(PAGE_HASH)}([0-9a-f]{{64}})", path.read_text(encoding="utf-8"))
    page = path.with_name(PAGE_FILE)
    if stated is None:
        return
    if not page.is_file():
        yield f"page: {PAGE_FILE} is not next to it, and was not compared"
    elif sha256(page.read_bytes()).hexdigest() != stated[1]:
        raise InputError(declared.OTHER_PAGE, page)
    else:
        yield f"page: {PAGE_FILE} is the one that was certified"
