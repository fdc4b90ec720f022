"""XML with names of any case."""

from __future__ import annotations

from xml.etree import ElementTree


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of an XML text, all tags and attributes in lower case."""
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise ValueError(f"expected an XML text, found: {error}") from error
    for element in root.iter():
        element.tag = element.tag.lower()
        for name in list(element.attrib):
            element.attrib[name.lower()] = element.attrib.pop(name)
    return root
