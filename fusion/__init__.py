"""From a recording folder to the sensitivity with its uncertainty.

Everything named here is public; a name is imported when it is first used, so that `import fusion` costs nothing. Paths
may be `str` or `Path`.

>>> from fusion import check, find_recordings, load_manifest
>>> (recording,) = find_recordings("sample_images/demo")
>>> manifest = load_manifest(recording)
>>> manifest.excitation.frequencies
(80.0,)
>>> check(manifest).problems
()
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
