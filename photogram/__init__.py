"""Images to rigid motion: subset tracking, triangulation, rigid fit.

Independent of shakers, clocks and sensors. Every name exported here is public and imported at its first use, so that
`import photogram` is fast. Examples assume `import numpy as np` and `from photogram import *`.
"""

from lazy_loader import attach_stub

from shakercal._common.version import __version__ as __version__

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
