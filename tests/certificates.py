"""A filled certificate.toml, a signed certificate, texts of the XML, rules of a Schematron file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lxml import etree
from support import DOCS

SCHEMA = Path(os.environ.get("SHAKERCAL_DATA", DOCS.parent.parent / "shared" / "data")) / "dcc" / "dcc-3.3.0.xsd"
NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
FORM = """
format = 1
[administration]
number = "2026-0815"
issued = 2026-11-23
received = 2026-11-15
begun = 2026-11-19
ended = 2026-11-20
operator = "Æsa 王"
authoriser = "B. Leader"
method = "Sinusoidal calibration on a shaker"
traceability = "Mass by certificate M-1"
[laboratory]
name = "Söhne <&\\"'> </script>"
city = "Braunschweig"
country = "DE"
[customer]
name = "Example & Co"
city = "Oslo"
country = "NO"
[item]
manufacturer = "Maker"
model = "W6"
condition = "without visible damage"
axes = "z out of the flange of the load"
[amplifier]
name = "Bridge amplifier 7"
supply = "5 V, 225 Hz"
[mounting]
description = "adapter plate, 8 screws M6"
torque = "10 N m"
[conditions]
temperature = [22.8, 23.3]
humidity = [0.40, 0.46]
[[equipment]]
use = "reference"
name = "load mass"
identification = "no. 3"
certificate = "M-1"
laboratory = "Mass laboratory"
[[equipment]]
use = "measuring"
name = "laser vibrometer"
identification = "no. 17"
certificate = "V-3"
laboratory = "Vibration laboratory"
valid_until = 2028-02-02
[conformity]
tolerance = 0.02
"""


def acknowledged(*codes: str) -> str:
    """The tables of certificate.toml that acknowledge kinds of notices."""
    return "".join(
        f'[[acknowledged]]\ncode = "{code}"\nreason = "reviewed"\nby = "B. Leader"\ndate = 2026-11-21\n'
        for code in codes
    )


SCH = {"sch": "http://purl.oclc.org/dsdl/schematron"}


def texts(root: etree._Element, path: str) -> list[str]:
    return [element.text for element in root.findall(path, NAMES)]


def broken_rules(document: Path, rules: Path) -> Iterator[tuple[str, str]]:
    """Yield role and text of every assertion that fails in a document, and of every report that fires.

    The rules are of XPath 2, which elementpath evaluates: no XSLT processor is needed.

    Of the rules of one pattern the first whose context a node matches counts (ISO/IEC 19757-3, 6.5); variables of a
    pattern are those of the document, variables of a rule those of the node.
    """
    import elementpath

    tree, schema = etree.parse(document), etree.parse(rules).getroot()
    names = {ns.get("prefix"): ns.get("uri") for ns in schema.findall("sch:ns", SCH)}
    names |= {"xs": "http://www.w3.org/2001/XMLSchema", "fn": "http://www.w3.org/2005/xpath-functions"}

    whole = elementpath.build_lxml_node_tree(tree)

    def value(path: str, item: Any, variables: dict[str, Any]) -> Any:
        parser = elementpath.XPath2Parser(names, variable_types=dict.fromkeys(variables, "item()*"))
        context = elementpath.XPathContext(whole, item=item, variables=variables)
        return list(parser.parse(path).select(context))

    for pattern in schema.iterfind(".//sch:pattern", SCH):
        of_pattern = {}
        for let in pattern.findall("sch:let", SCH):
            of_pattern[let.get("name")] = value(let.get("value"), None, of_pattern)
        seen: set[int] = set()
        for rule in pattern.findall("sch:rule", SCH):
            context = rule.get("context")
            path = context if context.startswith("/") else f"//({context})"
            for node in value(path, None, of_pattern):
                if id(node) in seen:
                    continue
                seen.add(id(node))
                of_rule = dict(of_pattern)
                for child in rule:
                    if child.tag == f"{{{SCH['sch']}}}let":
                        of_rule[child.get("name")] = value(child.get("value"), node, of_rule)
                    elif child.tag in (f"{{{SCH['sch']}}}assert", f"{{{SCH['sch']}}}report"):
                        (fulfilled,) = value(f"boolean({child.get('test')})", node, of_rule)
                        if fulfilled == child.tag.endswith("report"):
                            yield child.get("role", "error"), " ".join("".join(child.itertext()).split())


SIGNED = r"""<?xml version='1.0' encoding='utf-8'?>
<?style sheet?><!-- of the laboratory --><dcc:digitalCalibrationCertificate
  xmlns:si="https://ptb.de/si" xmlns:dcc="https://ptb.de/dcc" xmlns:unused="urn:unused" schemaVersion="3.3.0">
<dcc:administrativeData><dcc:coreData><dcc:uniqueIdentifier>S&#252;d &amp; 7</dcc:uniqueIdentifier
></dcc:coreData></dcc:administrativeData>
<dcc:measurementResults><dcc:measurementResult><dcc:results
><dcc:result id='m1'   refType='basic_mass'><!-- weighed --><dcc:name
><dcc:content lang="en">load mass</dcc:content></dcc:name>
<dcc:data><dcc:quantity><si:real><si:value>7</si:value><si:unit><![CDATA[\kilogram]]></si:unit
><si:expandedUnc><si:uncertainty>0.01</si:uncertainty><si:coverageFactor>2</si:coverageFactor
></si:expandedUnc></si:real></dcc:quantity></dcc:data></dcc:result></dcc:results></dcc:measurementResult
></dcc:measurementResults>
<Signature xmlns="http://www.w3.org/2000/09/xmldsig#">
<SignedInfo>
<CanonicalizationMethod Algorithm="http://www.w3.org/2001/10/xml-exc-c14n#"/>
<SignatureMethod Algorithm="http://www.w3.org/2001/04/xmldsig-more#ecdsa-sha256"/>
<Reference URI="">
<Transforms>
<Transform Algorithm="http://www.w3.org/2000/09/xmldsig#enveloped-signature"/>
<Transform Algorithm="http://www.w3.org/2006/12/xml-c14n11"/>
</Transforms>
<DigestMethod Algorithm="http://www.w3.org/2001/04/xmlenc#sha256"/>
<DigestValue>2rb989WTmt6s/2tEU4aXawE0DOgH9dufyA4zIir8NBU=</DigestValue>
</Reference>
</SignedInfo>
<SignatureValue>eIU5FB0opw3F7LYgybtn7T0ESo7z6M5kh5z7xz+nzv5uMYgXpmDWxQpcQCUccKbF
epXjEkLLKKUoCBQVHKKT/Q==</SignatureValue>
</Signature></dcc:digitalCalibrationCertificate>
"""
"""Signed by libxmlsec1 1.3 (ECDSA, SHA-256, C14N 1.1), then written in other words of XML: quotes, entities, CDATA."""
