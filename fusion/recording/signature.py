"""Changes of certificates after signing, by their XML signatures (W3C XML Signature 1.1).

The digests of the signed content are recomputed. The signature value and the key, hence the signer, are not verified.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from typing import Any

from lxml import etree

DS = "{http://www.w3.org/2000/09/xmldsig#}"
XMLNS = "{http://www.w3.org/XML/1998/namespace}"
EXCLUSIVE = "http://www.w3.org/2001/10/xml-exc-c14n#"
INCLUSIVE = ("http://www.w3.org/TR/2001/REC-xml-c14n-20010315", "http://www.w3.org/2006/12/xml-c14n11")
BY_VERSION = (f"{XMLNS}id", f"{XMLNS}base")
"""Attributes that only the first version of the canonical form inherits."""
COMMENTS = "WithComments"
ENVELOPED = "http://www.w3.org/2000/09/xmldsig#enveloped-signature"
XPATH = "http://www.w3.org/TR/1999/REC-xpath-19991116"
XPATH2 = "http://www.w3.org/2002/06/xmldsig-filter2"
WITHOUT_SIGNATURES = re.compile(r"\s*not\s*\(\s*ancestor-or-self::\w+:Signature\s*\)\s*")
SIGNATURES = re.compile(r"\s*(/descendant::|//)\w+:Signature\s*")
DIGESTS = {
    "http://www.w3.org/2000/09/xmldsig#sha1": "sha1",
    "http://www.w3.org/2001/04/xmldsig-more#sha224": "sha224",
    "http://www.w3.org/2001/04/xmlenc#sha256": "sha256",
    "http://www.w3.org/2001/04/xmldsig-more#sha384": "sha384",
    "http://www.w3.org/2001/04/xmlenc#sha512": "sha512",
    **{f"http://www.w3.org/2007/05/xmldsig-more#sha3-{bits}": f"sha3_{bits}" for bits in (224, 256, 384, 512)},
}
WHOLE = ("", "#xpointer(/)")
POINTER = re.compile(r"#xpointer\(id\((['\"])(.+)\1\)\)")


@dataclass(frozen=True)
class Signatures:
    """Result of checking the digests of a document's `count` signatures.

    `changed`: the part that differs from the signed one, empty if none does. `unchecked`: the reason if a required part
    could not be checked, else empty.
    """

    count: int
    changed: str = ""
    unchecked: str = ""


class _CannotCheck(Exception):
    """The reason why a digest cannot be recomputed."""


def check_signatures(root: Any, needed: tuple[str, ...]) -> Signatures:
    """Recompute the digests of all signatures; `needed`: paths of the parts that they must cover.

    The document must have been parsed with its comments and processing instructions. Signatures of a document are
    children of its root; a deeper one may belong to an embedded document.
    """
    signatures, unchecked, covered = root.findall(f"{DS}Signature"), list[str](), list[Any]()
    for signature in signatures:
        for reference in signature.findall(f"{DS}SignedInfo/{DS}Reference"):
            try:
                signed = _signed(root, reference)
                what = "document" if signed is root else f"element {str(reference.get('URI'))[:60]}"
                if signed is None:
                    return Signatures(len(signatures), f"no {what}")
                if not _agrees(root, signature, reference, signed):
                    return Signatures(len(signatures), f"a {what} with another digest ({_method(reference)})")
                covered.append(signed)
            except _CannotCheck as error:
                unchecked.append(str(error))
            except (etree.LxmlError, ValueError) as error:
                unchecked.append(" ".join(str(error).split())[:120])
    if not signatures and next(root.iter(f"{DS}Signature"), None) is not None:
        return Signatures(1, unchecked="it is no child of the root")
    for path in needed if signatures else ():
        for element in root.iterfind(path):
            if not any(part is element or part in element.iterancestors() for part in covered):
                unchecked.append(f"no digest covers dcc:{path.rpartition('}')[2]}")
                return Signatures(len(signatures), unchecked=unchecked[0])
    return Signatures(len(signatures))


def _method(reference: Any) -> str:
    """Return the name of a reference's digest in hashlib."""
    element = reference.find(f"{DS}DigestMethod")
    name = "" if element is None else element.get("Algorithm", "")
    if name not in DIGESTS:
        raise _CannotCheck(f"the digest {name or 'without a name'} is not supported")
    return DIGESTS[name]


def _signed(root: Any, reference: Any) -> Any | None:
    """Return the element of a reference, None if there is none."""
    uri = reference.get("URI")
    if uri is None:
        raise _CannotCheck("a reference without URI")
    if uri in WHOLE:
        return root
    pointer = POINTER.fullmatch(uri)
    name = pointer[2] if pointer else uri[1:]
    if not uri.startswith("#") or (not pointer and "(" in uri):
        raise _CannotCheck(f"the reference {uri[:60]!r} points outside the file")
    ids = ("Id", "ID", "id", f"{XMLNS}id")
    found = [element for element in root.iter(etree.Element) if any(element.get(key) == name for key in ids)]
    if len(found) > 1:
        raise _CannotCheck(f"{len(found)} elements have the id {name[:60]!r}")
    return found[0] if found else None


def _agrees(root: Any, signature: Any, reference: Any, signed: Any) -> bool:
    """Whether the element of a reference has the stated digest.

    Later signatures are no change: if the digest differs, it is recomputed without them. A reference by an empty URI or
    an id excludes comments, but some programs (signxml) include them.
    """
    stated = base64.b64decode("".join((reference.findtext(f"{DS}DigestValue") or "").split()))
    others = [other for other in root.findall(f"{DS}Signature") if other is not signature]
    for left_out, comments in product(([], others) if others else ([],), (False, True)):
        octets = _octets((root, signed), signature, reference, (left_out, comments))
        if hashlib.new(_method(reference), octets, usedforsecurity=False).digest() == stated:
            return True
    return False


def _octets(nodes: tuple[Any, Any], signature: Any, reference: Any, choice: tuple[list[Any], bool]) -> bytes:
    """Return the octets of the digest: element or document after the transforms of the reference.

    `nodes`: root and signed element. `choice`: elements to omit, and whether comments are included.
    """
    (root, signed), (left_out, comments) = nodes, choice
    dropped, canonical = list(left_out), _canonical(INCLUSIVE[0], "", comments)
    transforms = list(reference.iterfind(f"{DS}Transforms/{DS}Transform"))
    for index, transform in enumerate(transforms):
        name = transform.get("Algorithm", "")
        text = "".join(transform.itertext())
        subtracts = name == XPATH2 and {part.get("Filter") for part in transform} == {"subtract"}
        if name == ENVELOPED:
            dropped.append(signature)
        elif (name == XPATH and WITHOUT_SIGNATURES.fullmatch(text)) or (subtracts and SIGNATURES.fullmatch(text)):
            dropped += root.iter(f"{DS}Signature")
        elif name.startswith((EXCLUSIVE, *INCLUSIVE)) and index == len(transforms) - 1:
            prefixes = transform.find("{*}InclusiveNamespaces")
            canonical = _canonical(name, "" if prefixes is None else prefixes.get("PrefixList", ""), comments)
        else:
            raise _CannotCheck(f"the transform {name[:80]} is not supported")
    copied = _copied(signed, dropped)
    if reference.get("URI") in WHOLE:
        return canonical(copied.getroottree())
    return canonical(deepcopy(copied) if copied.getparent() is None else copied)  # without nodes before the root


def _canonical(name: str, prefixes: str, comments: bool) -> Callable[[Any], bytes]:
    """Return a function that writes an element, or a document, in a canonical form."""
    exclusive, inherited = name.startswith(EXCLUSIVE), [prefix for prefix in prefixes.split() if prefix != "#default"]

    def written(element: Any) -> bytes:
        if not exclusive and etree.iselement(element):  # attributes such as xml:lang are inherited
            for key, value in (item for above in element.iterancestors() for item in above.items()):
                if key.startswith(XMLNS) and (key not in BY_VERSION or name.startswith(INCLUSIVE[0])):
                    element.set(key, element.get(key, value))
                elif key == f"{XMLNS}base":
                    raise _CannotCheck("an element within xml:base")
        return bytes(
            etree.tostring(
                element,
                method="c14n",
                exclusive=exclusive,
                with_comments=comments and name.endswith(COMMENTS),
                inclusive_ns_prefixes=inherited if exclusive and inherited else None,
                with_tail=False,
            )
        )

    return written


def _copied(element: Any, dropped: list[Any]) -> Any:
    """Return a copy of an element in its document, without the elements `dropped`."""
    root = element.getroottree().getroot()
    paths = [_path(root, one) for one in (element, *dropped) if one is root or root in one.iterancestors()]
    tree = deepcopy(element.getroottree())
    copies = [_at(tree.getroot(), path) for path in paths]
    for copy in copies[1:]:
        parent, before = copy.getparent(), copy.getprevious()
        if parent is None:
            continue
        if copy.tail:  # text of the parent
            if before is None:
                parent.text = (parent.text or "") + copy.tail
            else:
                before.tail = (before.tail or "") + copy.tail
        copy.tail = None
        parent.remove(copy)
    return copies[0]


def _path(root: Any, element: Any) -> list[int]:
    """Return the path from the root to an element, by the numbers of children."""
    path = list[int]()
    while element is not root:
        parent = element.getparent()
        path.insert(0, parent.index(element))
        element = parent
    return path


def _at(root: Any, path: list[int]) -> Any:
    """Return the element at a path."""
    for number in path:
        root = root[number]
    return root
