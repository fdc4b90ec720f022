"""Dynamic calibration of multi-component force and moment sensors: one import for every public name.

A name is imported when it is first used, so that `import shakercal` costs nothing. The names are those of `photogram`
(images to rigid motion), `shaker` (signals and mechanics) and `fusion` (recordings to sensitivity with uncertainty).

>>> import shakercal
>>> evaluation = shakercal.evaluate("sample_images/demo/Fz-0080")
>>> round(abs(evaluation.sensitivity.value[0, 2, 2]) * 1e7, 1)
7.0
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any


def _public_names() -> dict[str, tuple[str, str]]:
    """Return the module and the name there of every public name, as `__init__.pyi` lists them."""
    tree = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    return {alias.asname or alias.name: (node.module or "", alias.name) for node in imports for alias in node.names}


_NAMES = {**_public_names(), "evaluate": ("fusion", "evaluate_recording")}
__all__ = sorted(_NAMES)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _NAMES:
        raise AttributeError(f"No {__name__} attribute {name}")
    module, inside = _NAMES[name]
    return getattr(import_module(module), inside)


def __dir__() -> list[str]:
    return __all__
