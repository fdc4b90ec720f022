"""Signals and mechanics of shaker measurements. Knows nothing of images.

Everything named here is public; a name is imported when it is first used, so that `import shaker` costs nothing.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
