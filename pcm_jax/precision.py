"""64-bit arithmetic for host entry points, whatever the user's own `jax_enable_x64` says.

The setting is scoped to the call (JAX's own context manager), so users' programs are untouched.
Kernels do not use this: they follow their inputs' dtype.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

_ALIGNMENT = 64  # bytes
P = ParamSpec("P")
R = TypeVar("R")


def in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """Decorates a host entry point: its body runs with 64-bit types enabled."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapper


def device_array(values: Any, dtype: Any = np.float64) -> jax.Array:
    """A JAX array of exactly `dtype`, also where 64-bit types are not enabled."""
    with jax.enable_x64(True):
        return jax.device_put(np.asarray(values, dtype=dtype))  # compiles nothing


def shareable_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """float64 zeros for `device_array` to take as they are, on a CPU, instead of copying them.

    XLA uses foreign memory that is aligned to its vector registers; nothing may be written into it
    from then on.
    """
    size = int(np.prod(shape)) * 8
    raw = np.zeros(size + _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    return raw[start : start + size].view(np.float64).reshape(shape)
