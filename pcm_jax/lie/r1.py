"""The real line under addition, entry by entry: the paper's one-dimensional world.

An element is the tuple (x,), a tangent vector likewise.
"""

from __future__ import annotations

from typing import Any

PARAMETERS_DIM = 1
TANGENT_DIM = 1
MATRIX_DIM = 2

Element = tuple[Any, ...]
Tangent = tuple[Any, ...]


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
