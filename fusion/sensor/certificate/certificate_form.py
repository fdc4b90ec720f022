"""certificate.toml: the statements of the laboratory, and a template of it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date as Date
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, model_validator

from fusion.errors import InputError
from fusion.recording.toml import read_toml, validate
from fusion.recording.values import ManifestBlock, NotNegative, Positive, refusal
from fusion.sensor.certificate.certificate_notices import NO_CERTIFICATE_FORM

FORM_FILE = "certificate.toml"
NEW_FORM = """\
format = 1
k = "effective"                         # or 2: U = 2 u whatever the degrees of freedom

[administration]
number = ""                             # of this certificate, unique
issued = 2026-01-31
received = 2026-01-15                   # the item's receipt
# begun = 2026-01-16                    # first and last day of the calibration, where recordings state no date
# ended = 2026-01-17
place = "laboratory"                    # laboratory, customer, laboratoryBranch, customerBranch, other
operator = ""                           # who measured
authoriser = ""                         # who is responsible for this certificate
method = "Sinusoidal calibration by inertial forces of a load mass on a shaker"
# procedure = ""                        # of the laboratory; recording.toml's by default
# traceability = ""                     # where no input names its certificate: how the results are traceable
# remarks = ""
# warnings_reviewed = true              # where the evaluation gives warnings: the authoriser has seen them

[laboratory]
name = ""
street = ""
post_code = ""
city = ""
country = "DE"                          # ISO 3166-1, two letters
# accreditation = ""
# email = ""

[laboratory.cmc]                        # optional: no U is stated below it
magnitude = 0.0                         # relative
phase = 0.0                             # rad

[customer]
name = ""
street = ""
post_code = ""
city = ""
country = "DE"

[item]                                  # name and serial number are those of rig.toml's sensor
manufacturer = ""
model = ""
condition = ""                          # as received
# customer_number = ""                  # the customer's own for it

# [conformity]                          # optional: a statement of conformity of the main elements
# tolerance = 0.02                      # of the magnitude, relative to the static sensitivity
# rule = "guarded"                      # "guarded": conforms if |deviation| + U is within; "simple": |deviation| alone
"""
"""Template written by `--draft`; empty texts are to be filled in."""


def _printable(text: str) -> str:
    """Refuse characters that XML cannot represent."""
    if any(ord(letter) < 32 or 0xD800 <= ord(letter) < 0xE000 or ord(letter) in (0xFFFE, 0xFFFF) for letter in text):
        raise refusal("a text of printable letters", repr(text)[:60])
    return " ".join(text.split())


def _country(code: str) -> str:
    """Refuse a text that is no country code; empty means not yet stated."""
    if code and not (len(code) == 2 and code.isascii() and code.isupper()):
        raise refusal("a country by its two capital letters (ISO 3166-1)", code)
    return code


PrintableText = Annotated[str, AfterValidator(_printable)]
Country = Annotated[str, AfterValidator(_country)]
REQUIRED, PERSONS = ("name", "city", "country"), ("operator", "authoriser")


class Party(ManifestBlock):
    """Laboratory or customer: name and address."""

    name: PrintableText = ""
    street: PrintableText = ""
    post_code: PrintableText = ""
    city: PrintableText = ""
    country: Country = ""
    email: PrintableText = ""


class MeasurementCapability(ManifestBlock):
    """Calibration and measurement capability: the smallest U of magnitude (relative) and phase (rad)."""

    magnitude: NotNegative = 0.0
    phase: NotNegative = 0.0


class Laboratory(Party):
    """The calibrating laboratory, with its accreditation and the smallest U that it may state."""

    accreditation: PrintableText = ""
    cmc: MeasurementCapability = MeasurementCapability()


class CalibratedItem(ManifestBlock):
    """The calibrated item, in addition to name and serial number of the sensor."""

    manufacturer: PrintableText = ""
    model: PrintableText = ""
    condition: PrintableText = ""
    customer_number: PrintableText = ""


class CertificateAdministration(ManifestBlock):
    """Number, days, location and persons of the calibration."""

    number: PrintableText = ""
    issued: Date | None = None
    received: Date | None = None
    begun: Date | None = None
    ended: Date | None = None
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "laboratory"
    operator: PrintableText = ""
    authoriser: PrintableText = ""
    method: PrintableText = ""
    procedure: PrintableText = ""
    traceability: PrintableText = ""
    remarks: PrintableText = ""
    warnings_reviewed: bool = False

    @model_validator(mode="after")
    def _ends_after_it_began(self) -> Self:
        if self.begun is not None and self.ended is not None and self.ended < self.begun:
            raise refusal(f"a day from {self.begun} on, when it began", f"{self.ended}", key="ended")
        return self


class Conformity(ManifestBlock):
    """Limit of the deviation from the static sensitivity, and the decision rule."""

    tolerance: Positive
    rule: Literal["guarded", "simple"] = "guarded"


class Form(ManifestBlock):
    """certificate.toml."""

    format: Literal[1]
    k: Literal["effective", 2] = "effective"
    administration: CertificateAdministration = CertificateAdministration()
    laboratory: Laboratory = Laboratory()
    customer: Party = Party()
    item: CalibratedItem = CalibratedItem()
    conformity: Conformity | None = None

    def missing(self) -> Iterator[str]:
        """Yield the required keys that are empty (ISO/IEC 17025:2017, 7.8.2)."""
        required = (
            (
                "administration",
                self.administration,
                ("number", "issued", "received", "operator", "authoriser", "method"),
            ),
            ("laboratory", self.laboratory, REQUIRED),
            ("customer", self.customer, REQUIRED),
            ("item", self.item, ("manufacturer", "model", "condition")),
        )
        yield from (f"{table}.{key}" for table, block, keys in required for key in keys if not getattr(block, key))


def read_form(path: Path) -> Form:
    """Read and check certificate.toml."""
    if not path.is_file():
        raise InputError(NO_CERTIFICATE_FORM, path)
    return validate(Form, read_toml(path), path)
