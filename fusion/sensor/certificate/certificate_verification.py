"""Verification of a certificate's file: content, signer, page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

from fusion.errors import InputError
from fusion.recording.dcc import read_dcc
from fusion.recording.signer import NOT_CHECKED, InvalidSigner, NoSignatureLibrary, verify_signer
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_xml import PAGE_FILE, PAGE_HASH


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
