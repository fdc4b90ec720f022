"""Images to rigid motion: subset tracking, triangulation, rigid fit. Knows nothing of shakers, clocks or sensors.

Everything named here is public; a name is imported when it is first used, so that `import photogram` costs nothing.
Examples assume `import numpy as np` and `from photogram import *`.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
