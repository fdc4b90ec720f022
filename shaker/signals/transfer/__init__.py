"""Transfer functions between sampled channels: periodic excitation, noise, impacts.

Sources of the notions: Pintelon and Schoukens, System Identification, 2nd ed. (2012); Bendat and Piersol, Random Data,
4th ed. (2010).
"""

from shaker.signals.chain import ratio_unit
from shaker.signals.transfer.impact import transfer_impact
from shaker.signals.transfer.periodic import transfer_periodic
from shaker.signals.transfer.random import transfer_random
from shaker.signals.transfer.result import Estimator, TransferFunction, TransferRecord

__all__ = [
    "Estimator",
    "TransferFunction",
    "TransferRecord",
    "ratio_unit",
    "transfer_impact",
    "transfer_periodic",
    "transfer_random",
]
