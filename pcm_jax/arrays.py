"""Arrays between the host and a device: where host code runs, what pads, which namespace computes.

Containers and host code hold NumPy arrays, float64. Three places send arrays to a device:
`consistency_problem`, the solver's problem and `merge_differentiable`. Host entry points are
decorated by `on_host`, so that what they compile runs in 64 bits, on the CPU, under JAX's standard
rules of promotion, whatever the caller's own settings say. Kernels do not use it: they follow
their inputs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from pcm_jax.errors import InputError

SMALLEST = 16  # rows
_ALIGNMENT = 64  # bytes
P = ParamSpec("P")
R = TypeVar("R")


def host_device() -> Any:
    """The CPU device of this process on which host code runs.

    Raises:
        InputError: if JAX was told to leave the CPU out.
    """
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        platforms = jax.config.values["jax_platforms"]
        raise InputError(
            f"JAX_PLATFORMS: {platforms!r} leaves out the CPU, on which maps are optimised and "
            "merged; expected 'cpu' among the platforms, as in 'cuda,cpu'"
        ) from error


@contextmanager
def standard_rules() -> Iterator[None]:
    """A scope of JAX's standard rules of promotion, under which the library is written.

    As a decorator, for kernels that users call: strict settings are meant for the user's own code.
    """
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@contextmanager
def host_scope() -> Iterator[None]:
    """A scope of 64-bit types, on the CPU, under JAX's standard rules of promotion.

    The settings are JAX's own context managers: they hold for this thread and this scope alone.
    Inside such a scope another one changes nothing, and is left out.
    """
    device = host_device()
    if _is_host(device):
        yield
        return
    with ExitStack() as scopes:
        scopes.enter_context(jax.enable_x64(True))
        scopes.enter_context(jax.default_device(device))
        scopes.enter_context(standard_rules())
        scopes.enter_context(jax.debug_nans(False))  # NaN is how a kernel says "no factor"
        scopes.enter_context(jax.debug_infs(False))
        yield


def _is_host(device: Any) -> bool:
    """True where all settings of `host_scope` are in force."""
    now: Any = jax.config
    return (
        now.jax_enable_x64
        and now.jax_default_device is device
        and now.jax_numpy_dtype_promotion == "standard"
        and now.jax_numpy_rank_promotion == "allow"
        and not (now.jax_debug_nans or now.jax_debug_infs)
    )


def on_host(function: Callable[P, R]) -> Callable[P, R]:
    """Decorates a host entry point: its body runs in `host_scope`."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with host_scope():
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


def namespace(*values: Any) -> ModuleType:
    """`numpy` when no value is a JAX array, else `jax.numpy`."""
    given = all(isinstance(value, np.ndarray | np.generic | float | int) for value in values)
    return np if given else jnp


def as_array(values: Any, argument: str) -> np.ndarray:
    """Makes an array of a user's values.

    Raises:
        InputError: where it makes nothing of them, as of rows of several lengths.
    """
    try:
        return np.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{argument}: {type(values).__name__} given, expected an array") from None


def as_numbers(values: Any, argument: str) -> np.ndarray:
    """Numbers as they are: booleans, complex and masked ones are none.

    Raises:
        InputError: for anything else.
    """
    array = as_array(values, argument)
    if array.dtype.kind not in "iuf" or isinstance(values, np.ma.MaskedArray):
        kind = type(values).__name__ if array.dtype.kind == "O" else array.dtype
        masked = "masked " * isinstance(values, np.ma.MaskedArray)
        raise InputError(f"{argument}: {masked}{kind} given, expected real numbers")
    return array


def as_real(values: Any, argument: str) -> np.ndarray:
    """Numbers as float64, see `as_numbers`."""
    return as_numbers(values, argument).astype(np.float64)


def bucket(size: int, *, smallest: int = SMALLEST, fine_above: int = 0) -> int:
    """The least of a few sizes that is at least `size`: padded problems share compilations.

    Args:
        size: how many rows are needed.
        smallest: sizes are this, doubled again and again,
        fine_above: and, beyond this size, what lies halfway between (a quarter less padding at
            most, for twice as many compilations).
    """
    upper = smallest
    while upper < size:
        upper *= 2
    halfway = 3 * upper // 4
    return halfway if upper > smallest and size <= halfway and halfway > fine_above else upper


def pad_leading(values: Any, size: int) -> np.ndarray:
    """Repeats the last row of `values` until the leading axis has `size` rows (zeros if empty)."""
    values = np.asarray(values)
    missing = size - values.shape[0]
    if missing < 0:
        raise ValueError(f"size: {size} is smaller than the {values.shape[0]} rows given")
    if values.shape[0] == 0:
        return np.zeros((size, *values.shape[1:]), values.dtype)
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])
