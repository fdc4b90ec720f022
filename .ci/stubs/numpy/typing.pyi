"""Annotations that mean anything."""

from typing import Any, TypeVar

from typing_extensions import TypeAliasType

_T = TypeVar("_T")
NDArray = TypeAliasType("NDArray", Any, type_params=(_T,))
ArrayLike = Any
