"""R¹ as a jaxlie group: the real line under addition."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float


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
