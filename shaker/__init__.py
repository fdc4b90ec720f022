"""Signals and mechanics of shaker measurements, independent of images.

Every name listed in the stub file is public. It is imported at its first use, so that `import shaker` is fast.
"""

from lazy_loader import attach_stub

from shakercal._common.version import __version__ as __version__

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
