"""Processor for comparing images: the CPU, or a GPU that torch can use."""

from __future__ import annotations

import ctypes
import sys
from importlib.util import find_spec

DEVICES = ("auto", "cpu", "cuda")
PACKAGES = ("torch", "kornia")


def resolve_device(choice: str) -> str:
    """Return the device 'cpu' or 'cuda' of `choice`.

    'auto' is 'cuda' where torch can use it. Importing torch takes seconds, so 'auto' imports it only if an NVIDIA
    driver can be loaded.
    """
    if choice not in DEVICES:
        raise ValueError(f"device: expected one of {', '.join(DEVICES)}, found {choice!r}")
    if choice == "cpu" or (choice == "auto" and not _has_driver()):
        return "cpu"
    if _torch_finds_cuda():
        return "cuda"
    if choice == "cuda":
        raise ValueError(f"device: expected a GPU that torch can use for 'cuda', found {_obstacle()}")
    return "cpu"


def _has_driver() -> bool:
    """Return whether the NVIDIA driver's library is present; takes microseconds if not."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def _missing_packages() -> list[str]:
    """Return the packages of the extra `gpu` that are not installed."""
    return [package for package in PACKAGES if find_spec(package) is None]


def _obstacle() -> str:
    """Describe what keeps torch from using a GPU, and its remedy."""
    missing = _missing_packages()
    if missing:
        return f'no package {" or ".join(missing)} (pip install "shakercal[gpu]")'
    if not _has_driver():
        return "no NVIDIA driver (try 'auto' or 'cpu')"
    return "a torch that is built without CUDA, or no GPU (install torch's build for CUDA, or try 'auto' or 'cpu')"


def _torch_finds_cuda() -> bool:
    """Return whether torch, built for CUDA, and kornia are installed and find a GPU."""
    if _missing_packages():
        return False
    import torch

    return bool(torch.cuda.is_available())
