"""Statements of the laboratory in certificate.toml, and a template of them."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date as Date
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BeforeValidator, model_validator

from fusion.errors import InputError
from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.toml import read_toml, validate
from fusion.recording.values import (
    ManifestBlock,
    NotNegative,
    Number,
    Positive,
    array_of_tables,
    describe,
    refusal,
    texts,
    vector,
)
from fusion.sensor import result_notices as declared

FORM_FILE = "certificate.toml"
NEW_FORM = '''\
format = 1
k = "effective"                         # or 2: the smallest k; few degrees of freedom have a larger one

[administration]
number = ""                             # of this certificate, unique
issued = ""                             # day, such as "2026-01-31"
received = ""                           # day of the item's receipt
# begun = ""                            # first and last day of the calibration, where recordings state no date
# ended = ""
place = "laboratory"                    # laboratory, customer, laboratoryBranch, customerBranch, other
operator = ""                           # who measured
authoriser = ""                         # who is responsible for this certificate
method = """METHOD"""
# procedure = ""                        # of the laboratory; recording.toml's by default
# traceability = ""                     # more on traceability than the certificates below
# remarks = ""

[laboratory]
name = ""
street = ""
post_code = ""
city = ""
country = ""                            # ISO 3166-1, two letters, such as "DE"
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
country = ""

[item]                                  # name and serial number are those of rig.toml's sensor
manufacturer = ""
model = ""
condition = ""                          # as received
axes = ""                               # how origin and axes are marked on the item
# customer_number = ""                  # the customer's own for it

[amplifier]                             # of the bridge of the item
name = ""                               # maker, type, serial number
supply = ""                             # of the bridge, such as "5 V, 4.8 kHz"
# filter = ""                           # low-pass, such as "Bessel, 10 kHz"

[mounting]
description = ""                        # adapter, screws, orientation of the shaker
torque = ""                             # of the screws, with unit

# [conditions]                          # where rig.toml states none: smallest and largest value
# temperature = [22.8, 23.3]            # °C
# humidity = [0.40, 0.46]               # relative

[[equipment]]
use = "reference"                       # reference, measuring
name = ""                               # such as "load mass"
identification = ""                     # maker, type, serial number
certificate = ""                        # number of its certificate
laboratory = ""                         # which issued it
# date = ""
# valid_until = ""
# inputs = ["load.mass"]                # keys of rig.toml and recording.toml that this certificate covers

[[equipment]]
use = "measuring"
name = ""                               # such as "laser vibrometer"
identification = ""
certificate = ""
laboratory = ""

# [[acknowledged]]                      # each kind of warning of the results, reviewed by the authoriser
# code = "SC-000"
# reason = ""
# by = ""
# date = 2026-01-31

# [conformity]                          # optional: a statement of conformity of the main elements
# tolerance = 0.02                      # of the magnitude, relative to the static sensitivity
# rule = "guarded"                      # "guarded": conforms if |deviation| + U is within; "simple": |deviation| alone
'''
"""Template written by `--draft`; empty texts are to be filled in, METHOD is that of the results."""
METHOD = """\
The item carries a load mass and is excited by sinusoidal motion of a shaker; force and moment follow from the mass
matrix of the load and its acceleration. The sensitivity is the complex amplitude of the output over that of the
load."""
"""Method of results of `run`, in two sentences."""


def _printable(text: str) -> str:
    """Refuse characters that XML cannot represent; lines become one."""
    spaced = " ".join(text.split())
    refused = (*range(32), *range(0xD800, 0xE000), 0xFFFE, 0xFFFF)
    if any(ord(letter) in refused for letter in spaced):
        raise refusal("a text of printable letters", repr(text)[:60])
    return spaced


def _country(code: str) -> str:
    """Refuse a text that is no country code; empty means not yet stated."""
    if code and not (len(code) == 2 and code.isascii() and code.isupper()):
        raise refusal("a country by its two capital letters (ISO 3166-1)", code)
    return code


def _day(value: object) -> object:
    """Return a day, also one in quotation marks; an empty text is not yet stated."""
    if not isinstance(value, str):
        return value
    try:
        return Date.fromisoformat(value) if value else None
    except ValueError as error:
        raise refusal("a day such as 2026-01-31", describe(value)) from error


def _range(value: object) -> tuple[float, ...]:
    """Return the smallest and the largest value of a condition."""
    low, high = vector(2)(value)
    if low > high:
        raise refusal("the smaller value first", describe([low, high]))
    return low, high


PrintableText = Annotated[str, AfterValidator(_printable)]
Country = Annotated[str, AfterValidator(_country)]
Day = Annotated[Date | None, BeforeValidator(_day)]
ValueRange = Annotated[tuple[Number, Number] | None, BeforeValidator(_range)]
Use = Literal["reference", "measuring"]
REQUIRED = {
    "administration": ("number", "issued", "received", "operator", "authoriser", "method"),
    "laboratory": ("name", "city", "country"),
    "customer": ("name", "city", "country"),
    "item": ("manufacturer", "model", "condition", "axes"),
    "amplifier": ("name", "supply"),
    "mounting": ("description", "torque"),
}
"""Keys of every table that must not be empty."""
REQUIRED_OF_EQUIPMENT = ("name", "identification", "certificate", "laboratory")


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
    axes: PrintableText = ""
    customer_number: PrintableText = ""


class BridgeAmplifier(ManifestBlock):
    """The amplifier that supplies the bridge of the item and reads it."""

    name: PrintableText = ""
    supply: PrintableText = ""
    filter: PrintableText = ""


class ItemMounting(ManifestBlock):
    """How the item is mounted on the shaker."""

    description: PrintableText = ""
    torque: PrintableText = ""


class StatedConditions(ManifestBlock):
    """Smallest and largest temperature, °C, and relative humidity during the calibration."""

    temperature: ValueRange = None
    humidity: ValueRange = None


class CertifiedEquipment(ManifestBlock):
    """A reference or a measuring instrument, with its certificate."""

    use: Use
    name: PrintableText = ""
    identification: PrintableText = ""
    certificate: PrintableText = ""
    laboratory: PrintableText = ""
    date: Day = None
    valid_until: Day = None
    inputs: Annotated[tuple[PrintableText, ...], BeforeValidator(texts)] = ()


class CertificateAdministration(ManifestBlock):
    """Number, days, location and persons of the calibration."""

    number: PrintableText = ""
    issued: Day = None
    received: Day = None
    begun: Day = None
    ended: Day = None
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "laboratory"
    operator: PrintableText = ""
    authoriser: PrintableText = ""
    method: PrintableText = ""
    procedure: PrintableText = ""
    traceability: PrintableText = ""
    remarks: PrintableText = ""

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
    amplifier: BridgeAmplifier = BridgeAmplifier()
    mounting: ItemMounting = ItemMounting()
    conditions: StatedConditions = StatedConditions()
    equipment: Annotated[tuple[CertifiedEquipment, ...], BeforeValidator(array_of_tables)] = ()
    acknowledged: Annotated[tuple[Acknowledgement, ...], BeforeValidator(array_of_tables)] = ()
    conformity: Conformity | None = None

    @property
    def least_k(self) -> float:
        """Return the smallest coverage factor; that of the effective degrees of freedom may be larger."""
        return 0.0 if self.k == "effective" else self.k

    def missing(self) -> Iterator[str]:
        """Yield the required keys that are empty (ISO/IEC 17025:2017, 7.8.2 and 7.8.4)."""
        for table, keys in REQUIRED.items():
            yield from (f"{table}.{key}" for key in keys if not getattr(getattr(self, table), key))
        for number, one in enumerate(self.equipment, 1):
            yield from (f"equipment[{number}].{key}" for key in REQUIRED_OF_EQUIPMENT if not getattr(one, key))
        for use in ("reference", "measuring"):
            if not any(one.use == use for one in self.equipment):
                yield f'equipment with use = "{use}"'


def read_form(path: Path) -> Form:
    """Read and check certificate.toml."""
    if not path.is_file():
        raise InputError(declared.NO_CERTIFICATE_FORM, path)
    return validate(Form, read_toml(path), path)
