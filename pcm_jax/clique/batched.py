"""Maximum cliques of many small graphs at once: one compiled program without callbacks.

The search of `exact` on machine words, cut into small equal steps: a step gives one vertex a
colour or enters one branch. A row of lanes takes such steps side by side, each lane on a graph of
its own, and a lane that is done takes the next graph: none waits for the slowest (as under a plain
`vmap` of a search, where all graphs take as many steps as the hardest).

Of equals, the lexicographically smallest (its vertices in ascending order), as `maximum_clique`
returns it: the colours spent on a branch exclude cliques as large as the one in hand only if what
the branch can reach does not precede that one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

from pcm_jax.clique.words import count, first, last, pack, precedes, single, some, unpack
from pcm_jax.errors import InputError

# Fewer spread the cost of calling a kernel over too few, more leave the second-level cache.
_LANES = 256
# Between two looks for lanes that are done.
_STEPS = 16


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
        max_steps: where the search gives up, in steps (a vertex coloured or a branch entered,
            rounded up to a multiple of 16); unlimited by default.

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
    """Where a search stands: sets [w, lanes]; as a stack, [w, depth · lanes]."""

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
    return lanes, taken + jnp.sum(done, dtype=jnp.int32), best, optimal


def _start(lanes: _Lanes, queue: _Queue, fresh: Array) -> _Lanes:
    """Lanes marked as fresh begin with their graph."""
    index = jnp.minimum(lanes.graph, len(queue.steps) - 1)
    candidates, best = queue.candidates[:, index], queue.best[:, index]
    size = count(best)
    none = jnp.zeros_like(candidates)

    def choose(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda new, old: jnp.where(fresh, new, old), new, old)

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
    """One vertex is coloured or, where no colour is left, one branch entered."""
    new_class = ~some(lanes.class_)
    # As many colours as vertices without one are enough.
    exhausted = new_class & (count(lanes.node.branches) <= lanes.colours)
    colouring = ~new_class | (~exhausted & (lanes.colours > 0))
    height = lanes.height - exhausted
    lane = np.arange(len(height), dtype=np.int32)
    top = jnp.maximum(height, 0) * len(height) + lane
    node = jax.tree.map(
        lambda stack, node: jnp.where(exhausted, stack.at[:, top].get(mode="clip"), node),
        lanes.stack,
        lanes.node,
    )
    class_ = jnp.where(new_class, node.branches, lanes.class_)
    # Colours go to the largest vertices first, so that the smallest are left to branch on.
    vertex = jnp.where(colouring, last(class_), first(node.branches))
    vertex = jnp.clip(vertex, 0, lanes.near.shape[-1] - 1)
    near, itself = lanes.near[:, lane, vertex], single(vertex, class_)

    node = node._replace(
        candidates=jnp.where(colouring, node.candidates, node.candidates & ~itself),
        branches=node.branches & ~itself,
    )
    inside, path = node.candidates & near, node.path | itself
    depth = count(path)
    active = ~colouring & (height >= 0)
    larger = depth > lanes.size
    better = active & (larger | ((depth == lanes.size) & precedes(path, lanes.best)))
    best, size = jnp.where(better, path, lanes.best), jnp.where(better, depth, lanes.size)
    colours = jnp.maximum(size - depth - precedes(path | inside, best), 0)
    entered = active & (count(inside) > colours)
    return lanes._replace(
        node=jax.tree.map(
            lambda new, old: jnp.where(entered, new, old), _Node(path, inside, inside), node
        ),
        colours=jnp.where(colouring, lanes.colours - new_class, jnp.where(entered, colours, 0)),
        class_=jnp.where(colouring, class_ & ~near & ~itself, 0),
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
