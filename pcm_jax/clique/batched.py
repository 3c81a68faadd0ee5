"""Maximum cliques of many small graphs at once: one compiled program without callbacks.

The search of `exact` on machine words, cut into small equal steps: a step gives a few vertices a
colour and enters at most one branch. A row of lanes takes such steps side by side, each lane on a
graph of its own, and a lane that is done takes the next graph: none waits for the slowest (as under
a plain `vmap` of a search, where all graphs take as many steps as the hardest).

Of equals, the lexicographically smallest (its vertices in ascending order), as `maximum_clique`
returns it: the colours spent on a branch exclude cliques as large as the one in hand only if what
the branch can reach does not precede that one.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

from pcm_jax.arrays import standard_rules
from pcm_jax.clique._words import count, first, last, pack, precedes, single, some, unpack
from pcm_jax.errors import InputError

# Fewer spread the cost of calling a kernel over too few, more leave the second-level cache.
_LANES = 256
# Vertices coloured per branch entered: a compromise between those that take many and none.
_COLOURED = 4
# Between two looks for lanes that are done.
_STEPS = 8


class BatchedCliques(NamedTuple):
    """Cliques of many graphs.

    Attributes:
        members: bool [..., m], True for the nodes of the clique.
        size: int32 [...], how many there are.
        optimal: bool [...], whether it is proven that none is larger, and of those as large none
            lexicographically smaller.
    """

    members: Bool[Array, "*batch m"]
    size: Int[Array, "*batch"]
    optimal: Bool[Array, "*batch"]


@standard_rules()
def maximum_clique_batched(
    graphs: Bool[Array, "*batch m m"],
    *,
    valid: Bool[Array, "*batch m"] | None = None,
    max_steps: int | Int[Array, "*batch"] | None = None,
) -> BatchedCliques:
    """A maximum clique of each of many small graphs; jit it.

    Meant for up to 64 nodes, though none is too large. Safe under `jit` and `vmap` (a mapped axis
    joins the batch); with 64-bit types enabled, graphs of more than 32 nodes take half the time.

    Args:
        graphs: symmetric (not checked), diagonals ignored.
        valid: the nodes that count; the others are in no clique. All, by default.
        max_steps: where the search gives up, in steps (up to four vertices coloured and a branch
            entered; rounded up to a multiple of 8); by default 2³¹ - 1.

    Returns:
        The lexicographically smallest of each graph's maximum cliques, which is the answer of
        `maximum_clique`; where the steps did not suffice, a clique that is marked as not optimal.

    Raises:
        InputError: graphs that are not square, or not bool.
    """
    if graphs.ndim < 2 or graphs.shape[-1] != graphs.shape[-2] or graphs.dtype != bool:
        found = f"{graphs.dtype} {list(graphs.shape)}"
        raise InputError(f"graphs: {found}, expected square matrices, bool [..., m, m]")
    *batch, m, _ = graphs.shape
    number = math.prod(batch)
    if number == 0 or m == 0:
        nothing = jnp.zeros((*batch, m), bool)
        return BatchedCliques(nothing, jnp.zeros(batch, jnp.int32), jnp.ones(batch, bool))
    limit = np.iinfo(np.int32).max if max_steps is None else max_steps
    members, optimal = _search(
        graphs.reshape(number, m, m),
        jnp.broadcast_to(True if valid is None else valid, (*batch, m)).reshape(number, m),
        jnp.broadcast_to(jnp.asarray(limit, jnp.int32), batch).reshape(number),
    )
    members = members.reshape(*batch, m)
    return BatchedCliques(members, members.sum(-1, dtype=jnp.int32), optimal.reshape(batch))


class _Node(NamedTuple):
    """The place where a search stands: sets [w, lanes]; as a stack, [w, depth · lanes]."""

    path: Array  # chosen
    candidates: Array  # adjacent to all of them, and not yet excluded
    branches: Array  # candidates to choose next; while colouring, those without a colour


class _Lanes(NamedTuple):
    """The lanes' searches; sets are [w, lanes], all else but `near` and the stack [lanes]."""

    graph: Array  # index of the graph, or of none: the number of graphs
    steps: Array  # left before the search gives up
    near: Array  # neighbours [w, lanes, m]
    node: _Node
    colours: Array  # left for the branches, not negative
    class_: Array  # what may still join the present colour class
    stack: _Node  # nodes to return to; entries from `height` on are leftovers
    height: Array  # of the stack; negative once the search is complete
    best: Array
    size: Array  # of the best


class _Queue(NamedTuple):
    """The graphs, and what is known of each before its search."""

    near: UInt[Array, "w number m"]
    candidates: UInt[Array, "w number"]
    best: UInt[Array, "w number"]
    steps: Int[Array, " number"]


@jax.custom_batching.custom_vmap
def _search(graphs: Array, valid: Array, max_steps: Array) -> tuple[Array, Array]:
    """Members [number, m] and certificates [number] of graphs [number, m, m]."""
    number, m, _ = graphs.shape
    near = pack(graphs & valid[:, None] & ~np.eye(m, dtype=bool))
    best = _greedy(near, pack(valid))
    # Who has fewer neighbours than a clique as large as that has members is in none.
    possible = count(near) >= count(best)[:, None] - 1
    queue = _Queue(near, pack(possible & valid), best, max_steps)

    def unfinished(state: tuple[Any, ...]) -> Array:
        return jnp.any(state[0].graph < number)

    def advance(state: tuple[Any, ...]) -> tuple[Any, ...]:
        lanes, *rest = state
        lanes = jax.lax.fori_loop(0, _STEPS, lambda _, lanes: _step(lanes), lanes)
        return _exchange(lanes._replace(steps=lanes.steps - _STEPS), queue, *rest)

    start = _exchange(_idle(queue), queue, jnp.int32(0), best, jnp.zeros(number, bool))
    _, _, best, optimal = jax.lax.while_loop(unfinished, advance, start)
    return unpack(best, m), optimal


@_search.def_vmap
def _(size: int, mapped: list[bool], *arguments: Array) -> tuple[Any, Any]:
    """The mapped axis joins the batch."""
    merged = [
        (each if has_axis else jnp.broadcast_to(each, (size, *each.shape))).reshape(
            -1, *each.shape[1 + has_axis :]
        )
        for each, has_axis in zip(arguments, mapped, strict=True)
    ]
    members, optimal = _search(*merged)
    return (members.reshape(size, -1, members.shape[-1]), optimal.reshape(size, -1)), (True, True)


def _greedy(near: Array, candidates: Array) -> Array:
    """In each graph, always the candidate of largest degree, ties by index."""
    _, number, m = near.shape
    # The vertex within the number, since a maximum is found much faster than where it is.
    rank = count(near) * m + np.arange(m - 1, -1, -1, dtype=np.int32)

    def grow(state: tuple[Array, Array]) -> tuple[Array, Array]:
        candidates, clique = state
        leading = jnp.max(jnp.where(unpack(candidates, m), rank, 0), axis=1)
        vertex = m - 1 - leading % m
        clique |= jnp.where(some(candidates), single(vertex, clique), 0)
        return candidates & near[:, np.arange(number), vertex], clique

    start = candidates, jnp.zeros_like(candidates)
    return jax.lax.while_loop(lambda state: jnp.any(some(state[0])), grow, start)[1]


def _idle(queue: _Queue) -> _Lanes:
    """Lanes that wait for their first graph."""
    words, number, m = queue.near.shape
    lanes = min(_LANES, number)
    none = jnp.zeros((words, lanes), queue.near.dtype)
    zero = jnp.zeros(lanes, jnp.int32)
    stack = jnp.zeros((words, m * lanes), none.dtype)
    return _Lanes(
        graph=jnp.full(lanes, number, jnp.int32),
        steps=zero,
        near=jnp.zeros((words, lanes, m), none.dtype),
        node=_Node(none, none, none),
        colours=zero,
        class_=none,
        stack=_Node(stack, stack, stack),
        height=zero - 1,
        best=none,
        size=zero,
    )


def _exchange(
    lanes: _Lanes, queue: _Queue, taken: Array, best: Array, optimal: Array
) -> tuple[_Lanes, Array, Array, Array]:
    """Lanes that are done hand in their cliques and take the graphs that are next."""
    number = len(queue.steps)
    complete = lanes.height < 0
    done = complete | (lanes.steps <= 0)
    finished = jnp.where(done, lanes.graph, number)
    best = best.at[:, finished].set(lanes.best, mode="drop")
    optimal = optimal.at[finished].set(complete, mode="drop")

    # Beyond the last graph: idle lanes, which nothing waits for.
    graph = jnp.where(done, taken - 1 + jnp.cumsum(done, dtype=jnp.int32), lanes.graph)
    graph = jnp.minimum(graph, number)
    lanes = _start(lanes._replace(graph=graph), queue, done & (graph < number))
    taken = jnp.minimum(taken + jnp.sum(done, dtype=jnp.int32), number)
    return lanes, taken, best, optimal


def _start(lanes: _Lanes, queue: _Queue, fresh: Array) -> _Lanes:
    """Lanes marked as fresh begin with their graph."""
    index = jnp.minimum(lanes.graph, len(queue.steps) - 1)
    candidates, best = queue.candidates[:, index], queue.best[:, index]
    size = count(best)
    none = jnp.zeros_like(candidates)
    choose = partial(_choose, fresh)
    return lanes._replace(
        steps=choose(queue.steps[index], lanes.steps),
        near=jnp.where(fresh[:, None], queue.near[:, index], lanes.near),
        node=choose(_Node(none, candidates, candidates), lanes.node),
        colours=choose(jnp.maximum(size - precedes(candidates, best), 0), lanes.colours),
        class_=choose(none, lanes.class_),
        height=choose(jnp.zeros_like(size), lanes.height),
        best=choose(best, lanes.best),
        size=choose(size, lanes.size),
    )


def _step(lanes: _Lanes) -> _Lanes:
    """Some vertices are coloured and, where no colour is left to give, one branch is entered."""
    # A loop, since compiled in a row they would be fused with much computed again.
    return _branch(jax.lax.fori_loop(0, _COLOURED, lambda _, lanes: _colour(lanes), lanes))


def _colouring(lanes: _Lanes) -> Array:
    """The lanes that colour their vertices: as many colours as vertices would do at once."""
    open_ = (lanes.colours > 0) & (count(lanes.node.branches) > lanes.colours)
    return some(lanes.class_) | open_


def _colour(lanes: _Lanes) -> _Lanes:
    """The next vertex gets a colour: largest first, so that the smallest are left to branch on."""
    colouring, new_class = _colouring(lanes), ~some(lanes.class_)
    class_ = jnp.where(new_class, lanes.node.branches, lanes.class_)
    near, itself = _look(lanes, last(class_))
    itself = jnp.where(colouring, itself, 0)
    return lanes._replace(
        node=lanes.node._replace(branches=lanes.node.branches & ~itself),
        colours=lanes.colours - (colouring & new_class),
        class_=jnp.where(colouring, class_ & ~near & ~itself, 0),
    )


def _branch(lanes: _Lanes) -> _Lanes:
    """The smallest vertex without a colour joins the path; where there is none, a step back."""
    active = ~_colouring(lanes)
    back = active & (count(lanes.node.branches) <= lanes.colours)
    height = lanes.height - back
    top = jnp.maximum(height, 0) * len(height) + np.arange(len(height), dtype=np.int32)
    node = jax.tree.map(
        lambda stack, node: jnp.where(back, stack.at[:, top].get(mode="clip"), node),
        lanes.stack,
        lanes.node,
    )
    active &= height >= 0
    near, itself = _look(lanes, first(node.branches))
    itself = jnp.where(active, itself, 0)
    node = node._replace(candidates=node.candidates & ~itself, branches=node.branches & ~itself)
    inside, path = node.candidates & near, node.path | itself
    depth = count(path)
    equal = (depth == lanes.size) & precedes(path, lanes.best)
    better = active & ((depth > lanes.size) | equal)
    best, size = jnp.where(better, path, lanes.best), jnp.where(better, depth, lanes.size)
    colours = jnp.maximum(size - depth - precedes(path | inside, best), 0)
    entered = active & (count(inside) > colours)
    return lanes._replace(
        node=_choose(entered, _Node(path, inside, inside), node),
        colours=jnp.where(entered, colours, jnp.where(active, 0, lanes.colours)),
        # Written always: what is not entered lies above the stack's height.
        stack=jax.tree.map(
            lambda stack, node: stack.at[:, top].set(node, mode="drop", unique_indices=True),
            lanes.stack,
            node,
        ),
        height=height + (entered & some(node.branches)),
        best=best,
        size=size,
    )


def _look(lanes: _Lanes, vertex: Array) -> tuple[Array, Array]:
    """The neighbours of a vertex in every lane, and the set of itself."""
    vertex = jnp.clip(vertex, 0, lanes.near.shape[-1] - 1)
    return lanes.near[:, np.arange(len(vertex)), vertex], single(vertex, lanes.class_)


def _choose(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)
