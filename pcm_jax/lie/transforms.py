"""Operations on jaxlie's `SE2` and `SE3` and on `R1`, with any leading batch axes.

One function serves all three groups, through the entry-by-entry modules `se2`, `se3` and `r1`.
Transforms backed by NumPy arrays are computed in NumPy and give NumPy-backed transforms; anything
else goes through a jitted JAX function, safe under jit, vmap and grad.

jaxlie's classes are the containers only. Its own exp, log and Jacobians lose up to ten digits at
small rotations and are not used.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any, TypeVar

import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from pcm_jax import arrays
from pcm_jax.arrays import device_array, namespace, standard_rules
from pcm_jax.errors import InputError
from pcm_jax.lie import r1, se2, se3, unrolled
from pcm_jax.lie.r1 import R1

Transform = TypeVar("Transform", bound=jaxlie.MatrixLieGroup)
Group = type[Transform]

_MODULES: dict[type, ModuleType] = {jaxlie.SE2: se2, jaxlie.SE3: se3, R1: r1}
_BY_MATRIX_DIM: dict[int, type] = {module.MATRIX_DIM: group for group, module in _MODULES.items()}
_FIELDS = {jaxlie.SE2: "unit_complex_xy", jaxlie.SE3: "wxyz_xyz", R1: "x"}
F = TypeVar("F", bound=Callable[..., Any])


@contextlib.contextmanager
def own_precision(tree: Any) -> Iterator[None]:
    """A scope for kernels: 64-bit types if `tree` holds any array of them; standard promotion."""
    wide = any(getattr(leaf, "dtype", None) == np.float64 for leaf in jax.tree.leaves(tree))
    with jax.enable_x64(True) if wide else contextlib.nullcontext(), standard_rules():
        yield


def _jit_unless_numpy(function: F) -> F:
    """Runs `function` in NumPy when all its arrays are NumPy's, else as one compiled JAX function.

    An argument called `group` is static. 64-bit input is computed in 64 bits, whatever the setting.
    """
    names = [name for name in inspect.signature(function).parameters if name == "group"]
    jitted = jax.jit(function, static_argnames=names)

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if not kwargs and all(map(_is_plain, args)):  # flattening takes longer than small products
            return function(*args)
        leaves = jax.tree.leaves((args, kwargs))
        if all(isinstance(leaf, np.ndarray | type) for leaf in leaves):
            return function(*args, **kwargs)
        with own_precision(leaves):
            return jitted(*args, **kwargs)

    return wrapper  # type: ignore[return-value]


def _is_plain(given: Any) -> bool:
    """True for a NumPy array, a transform that is stored in one, or a group."""
    if isinstance(given, np.ndarray | type):
        return True
    field = _FIELDS.get(type(given))
    return field is not None and isinstance(getattr(given, field), np.ndarray)


def module_of(group: Group[Any]) -> ModuleType:
    """The entry-by-entry module (`se2`, `se3`, `r1`) of a group."""
    module = _MODULES.get(group)
    if module is None:
        raise InputError(
            f"group: {getattr(group, '__name__', group)!r} is not supported; expected jaxlie.SE2, "
            "jaxlie.SE3 or pcm_jax.lie.R1"
        )
    return module


def group_of(transform: jaxlie.MatrixLieGroup) -> Group[Any]:
    """The group a transform belongs to; `InputError` for unsupported ones."""
    module_of(type(transform))
    return type(transform)


def tangent_dim(transform_or_group: Any) -> int:
    """d: 3 for SE(2), 6 for SE(3), 1 for R¹."""
    group = transform_or_group if isinstance(transform_or_group, type) else type(transform_or_group)
    return module_of(group).TANGENT_DIM


def parameters(transform: jaxlie.MatrixLieGroup) -> Float[Array, "*batch p"]:
    """The array a transform is stored in, untouched (jaxlie's own accessor may cast it)."""
    return getattr(transform, _FIELDS[group_of(transform)])


def components(transform: jaxlie.MatrixLieGroup) -> tuple[Any, ...]:
    """The parameters, one array of the batch's shape each."""
    values = parameters(transform)
    return tuple(values[..., k] for k in range(values.shape[-1]))


def from_components(group: Group[Transform], values: Sequence[Any]) -> Transform:
    """A transform from one array per parameter; the arrays broadcast against each other."""
    return group(_stack(values))  # type: ignore[call-arg]


def _split(tangent: Any) -> tuple[Any, ...]:
    return tuple(tangent[..., k] for k in range(tangent.shape[-1]))


def _stack(values: Sequence[Any]) -> Any:
    first = values[0]
    if all(type(each) is np.ndarray and _alike(each, first) for each in values):
        return np.stack(values, axis=-1)
    xp = namespace(*values)
    return xp.stack(xp.broadcast_arrays(*values), axis=-1)


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype


@_jit_unless_numpy
def exp(group: Group[Transform], tangent: Float[Array, "*batch d"]) -> Transform:
    """Exponential map.

    Args:
        group: `jaxlie.SE2`, `jaxlie.SE3` or `R1`.
        tangent: (translation, rotation), metres and radians.
    """
    return from_components(group, module_of(group).exp(_split(tangent)))


@_jit_unless_numpy
def log(transform: jaxlie.MatrixLieGroup) -> Float[Array, "*batch d"]:
    """Logarithm: (translation, rotation), the rotation's angle at most π."""
    return _stack(module_of(group_of(transform)).log(components(transform)))


@_jit_unless_numpy
def adjoint(transform: jaxlie.MatrixLieGroup) -> Float[Array, "*batch d d"]:
    """Ad with `T exp(δ) T⁻¹ = exp(Ad δ)`: takes right perturbations to left ones."""
    values = components(transform)
    return unrolled.to_array(module_of(group_of(transform)).adjoint(values), like=values[0])


@_jit_unless_numpy
def right_jacobian(
    group: Group[Any], tangent: Float[Array, "*batch d"]
) -> Float[Array, "*batch d d"]:
    """Jr with `exp(τ + δ) = exp(τ) exp(Jr δ)` to first order in δ."""
    values = _split(tangent)
    return unrolled.to_array(module_of(group).right_jacobian(values), like=values[0])


@_jit_unless_numpy
def right_jacobian_inverse(
    group: Group[Any], tangent: Float[Array, "*batch d"]
) -> Float[Array, "*batch d d"]:
    """Jr⁻¹: the derivative of `Log(exp(τ) exp(δ))` at δ = 0."""
    values = _split(tangent)
    return unrolled.to_array(module_of(group).right_jacobian_inverse(values), like=values[0])


@_jit_unless_numpy
def compose(a: Transform, b: Transform) -> Transform:
    """The product a b; batch axes broadcast."""
    group = group_of(a)
    return from_components(group, module_of(group).compose(components(a), components(b)))


@_jit_unless_numpy
def inverse(transform: Transform) -> Transform:
    """The inverse."""
    group = group_of(transform)
    return from_components(group, module_of(group).inverse(components(transform)))


@_jit_unless_numpy
def between(a: Transform, b: Transform) -> Transform:
    """The product a⁻¹ b, the pose of b seen from a; batch axes broadcast."""
    group = group_of(a)
    module = module_of(group)
    return from_components(group, module.compose(module.inverse(components(a)), components(b)))


@_jit_unless_numpy
def normalize(transform: Transform) -> Transform:
    """The same transform with its rotation's parameters scaled to unit length."""
    group = group_of(transform)
    return from_components(group, module_of(group).normalize(components(transform)))


def translation(transform: jaxlie.MatrixLieGroup) -> Any:
    """Translations `[..., s]`, for poses their positions, metres: the last of the parameters."""
    space = module_of(group_of(transform)).MATRIX_DIM - 1
    return parameters(transform)[..., -space:]


@_jit_unless_numpy
def as_matrix(transform: jaxlie.MatrixLieGroup) -> Float[Array, "*batch s s"]:
    """Homogeneous matrices."""
    values = components(transform)
    return unrolled.to_array(module_of(group_of(transform)).to_matrix(values), like=values[0])


@_jit_unless_numpy
def from_matrix(matrix: Float[Array, "*batch s s"]) -> Any:
    """From homogeneous matrices: `[..., 3, 3]` is SE(2), `[..., 4, 4]` SE(3), `[..., 2, 2]` R¹.

    The rotation is taken to be one up to rounding; nothing is checked.
    """
    group = _BY_MATRIX_DIM.get(matrix.shape[-1])
    if group is None or matrix.shape[-2] != matrix.shape[-1]:
        raise InputError(
            f"matrix: shape {tuple(matrix.shape)}; expected [..., 3, 3] (SE(2)), [..., 4, 4] "
            "(SE(3)) or [..., 2, 2] (the real line)"
        )
    return from_components(group, module_of(group).from_matrix(unrolled.from_array(matrix)))


def identity(group: Group[Transform], batch: tuple[int, ...] = (), *, xp: Any = np) -> Transform:
    """Identities of the given batch shape, in NumPy float64 unless `xp` is `jax.numpy`."""
    row = xp.asarray(module_of(group).identity())
    return group(xp.broadcast_to(row, (*batch, row.shape[0])))  # type: ignore[call-arg]


def take(transform: Transform, index: Any) -> Transform:
    """Elements of a batch, by anything that indexes an array's leading axes."""
    return group_of(transform)(parameters(transform)[index])  # type: ignore[call-arg]


def concatenate(transforms: Sequence[Transform]) -> Transform:
    """Batches joined along their first axis."""
    values = [parameters(transform) for transform in transforms]
    group = group_of(transforms[0])
    return group(namespace(*values).concatenate(values, axis=0))  # type: ignore[call-arg]


def stack(transforms: Sequence[Transform]) -> Transform:
    """Transforms of equal batch shape, along a new first axis."""
    values = [parameters(transform) for transform in transforms]
    group = group_of(transforms[0])
    return group(namespace(*values).stack(values, axis=0))  # type: ignore[call-arg]


def pad_leading(transform: Transform, size: int) -> Transform:
    """A NumPy-backed batch of `size`: the last element repeated, identities if there is none."""
    values = np.asarray(parameters(transform))
    if len(values) == 0:
        return identity(group_of(transform), (size, *values.shape[1:-1]))
    return group_of(transform)(arrays.pad_leading(values, size))  # type: ignore[call-arg]


def as_numpy(transform: Transform) -> Transform:
    """The same transform backed by NumPy float64: for host code, whatever the x64 setting."""
    values = np.asarray(parameters(transform), dtype=np.float64)
    return group_of(transform)(values)  # type: ignore[call-arg]


def as_device(transform: Transform, dtype: Any = np.float64) -> Transform:
    """The same transform backed by a JAX array of exactly `dtype`, whatever the x64 setting."""
    return group_of(transform)(device_array(parameters(transform), dtype))  # type: ignore[call-arg]
