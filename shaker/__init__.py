"""Signals and mechanics of shaker measurements. Knows nothing of images.

Everything named here is public; a name is imported when it is first used, so that `import shaker` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shaker.io.channel import RawChannel
    from shaker.io.read import read_channels

_MODULES = {
    "RawChannel": "shaker.io.channel",
    "read_channels": "shaker.io.read",
}
"""Where each public name lives."""

__all__ = ["RawChannel", "__version__", "read_channels"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("shakercal")
    elif name in _MODULES:
        from importlib import import_module

        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
