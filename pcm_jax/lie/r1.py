"""The real line under addition: the paper's one-dimensional world.

`R1` is the container, as `jaxlie.SE2` and `SE3` are for the other groups. The functions below it
work entry by entry: an element is the tuple (x,), a tangent vector likewise.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

PARAMETERS_DIM = 1
TANGENT_DIM = 1
MATRIX_DIM = 2

Element = tuple[Any, ...]
Tangent = tuple[Any, ...]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class R1(jaxlie.MatrixLieGroup):
    """The real line, the group of the paper's one-dimensional world.

    Attributes:
        x: the coordinate, with an axis of length one after the batch axes.
    """

    matrix_dim = 2
    parameters_dim = 1
    tangent_dim = 1
    space_dim = 1

    x: Float[Array, "*batch 1"]

    @classmethod
    def identity(cls, batch_axes: tuple[int, ...] = ()) -> R1:
        """The origin."""
        return cls(jnp.zeros((*batch_axes, 1)))

    @classmethod
    def from_matrix(cls, matrix: Any) -> R1:
        """From [[1, x], [0, 1]]."""
        return cls(matrix[..., 0, 1:])

    def as_matrix(self) -> jax.Array:
        """[[1, x], [0, 1]]."""
        one, zero = jnp.ones_like(self.x), jnp.zeros_like(self.x)
        return jnp.stack([jnp.concatenate([one, self.x], -1), jnp.concatenate([zero, one], -1)], -2)

    def parameters(self) -> jax.Array:
        """The coordinate, `[..., 1]`."""
        return self.x

    def apply(self, target: Any) -> jax.Array:
        """`target` moved by x."""
        return self.x + target

    def multiply(self, other: R1) -> R1:
        """The sum of the two."""
        return R1(self.x + other.x)

    @classmethod
    def exp(cls, tangent: Any) -> R1:
        """The tangent vector as an element."""
        return cls(tangent)

    def log(self) -> jax.Array:
        """The coordinate, `[..., 1]`."""
        return self.x

    def adjoint(self) -> jax.Array:
        """One."""
        return jnp.ones_like(self.x)[..., None]

    def inverse(self) -> R1:
        """−x."""
        return R1(-self.x)

    def normalize(self) -> R1:
        """The element itself."""
        return self

    def jlog(self) -> jax.Array:
        """One."""
        return self.adjoint()

    @classmethod
    def sample_uniform(cls, key: jax.Array, batch_axes: tuple[int, ...] = ()) -> R1:
        """Uniform in [-1, 1]."""
        return cls(jax.random.uniform(key, (*batch_axes, 1), minval=-1.0, maxval=1.0))


def identity() -> Element:
    """The origin."""
    return (0.0,)


def compose(a: Element, b: Element) -> Element:
    """The sum."""
    return (a[0] + b[0],)


def inverse(a: Element) -> Element:
    """The negative."""
    return (-a[0],)


def exp(tangent: Tangent) -> Element:
    """The element itself."""
    return (tangent[0],)


def log(a: Element) -> Tangent:
    """The coordinate itself."""
    return (a[0],)


def adjoint(_: Element) -> tuple[tuple[Any, ...], ...]:
    """One: the group is commutative."""
    return ((1.0,),)


def adjoint_sandwich(_: Element, symmetric: Any) -> Any:
    """The variance itself."""
    return symmetric


def left_tangent(_: Element, velocity: Element) -> Tangent:
    """The velocity itself."""
    return velocity


def bracket(_a: Tangent, _b: Tangent) -> Tangent:
    """Zero: the group is commutative."""
    return (0.0,)


def right_jacobian(_: Tangent) -> tuple[tuple[Any, ...], ...]:
    """One."""
    return ((1.0,),)


def right_jacobian_inverse(_: Tangent) -> tuple[tuple[Any, ...], ...]:
    """One."""
    return ((1.0,),)


def normalize(a: Element) -> Element:
    """The element itself: every number is valid."""
    return a


def to_matrix(a: Element) -> tuple[tuple[Any, ...], ...]:
    """[[1, x], [0, 1]]."""
    return ((1.0, a[0]), (0.0, 1.0))


def from_matrix(matrix: Any) -> Element:
    """From the entries of [[1, x], [0, 1]]."""
    return (matrix[0][1],)
