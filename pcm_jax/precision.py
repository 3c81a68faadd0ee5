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
        return jax.device_put(np.asarray(values, dtype=dtype))  # copies; compiles nothing
