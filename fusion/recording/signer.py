"""Signer of a certificate: key and X.509 certificate of its XML signature, checked with `signxml`."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date as Date
from importlib import import_module
from pathlib import Path
from typing import Any

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
