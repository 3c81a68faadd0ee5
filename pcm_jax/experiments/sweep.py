"""Every method at every gate on thousands of simulated worlds: one compiled program.

World w of a sweep is drawn from the random key `fold_in(key(seed), w)` and from nothing else. The
program draws worlds, weighs their closures (Q), lets every method choose at every gate and counts,
without the host. A device takes worlds in blocks that fit its caches, one block after the other,
always of the same size: how many worlds are asked for at once, and how many devices share them,
changes no number.

A call that was killed goes on where it stopped, and one with more worlds adds those:

```python
import pyarrow.parquet
grid = dict(methods=("pcm-heuristic", "ransac"), confidences=(0.11, 0.99), poses=200, random=20)
pcm.sweep("sweep", worlds=200, **grid)
rows = pyarrow.parquet.read_table("sweep")             # pandas and polars read the folder as well
```

A mesh shares the work out, Q by rows and sweeps by worlds; the numbers stay the same:

```python
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
shared = pcm.squared_mahalanobis(problem, mesh=mesh)   # padded to a multiple of the devices
pcm.sweep("sweep", worlds=400, mesh=mesh, **grid)      # 200 are there: 200 are added
```

- One node, several GPUs: just that. On a CPU, the environment variable
  `XLA_FLAGS=--xla_force_host_platform_device_count=8` makes eight devices of it.
- Several hosts (a TPU slice, Slurm): start the same script on each, and call
  `jax.distributed.initialize()` before all else of JAX; there it finds the others by itself.
  Elsewhere it takes the first host's address, how many there are and one's own number.
  `jax.devices()` is then all of theirs. The first process writes the sweep; of Q each has its own
  rows, `shared.addressable_shards`.
- Compiling once: `jax.config.update("jax_compilation_cache_dir", "…")` keeps what is compiled for
  all processes to come. Two cores' first `sweep` took 2 s of processor time instead of 13, the
  first `merge` 5 s instead of 7.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import chi2_gate, squared_mahalanobis
from pcm_jax.errors import InputError
from pcm_jax.evaluation.metrics import false_positive_rate, precision, true_positive_rate
from pcm_jax.experiments._sweep_files import SweepFiles
from pcm_jax.selection import select_batched
from pcm_jax.selection.batched import kernel_of
from pcm_jax.simulation import simulate_chains
from pcm_jax.simulation.world import require_positive

METHODS = ("pcm-heuristic", "ransac", "scgp")
# Of a block: entries of its worlds' Q at most, and worlds at most.
_ENTRIES, _WORLDS = 1 << 18, 64
_MOST_WORLDS = 1 << 32  # what a key can be folded with
_FORMAT = 1  # of the files
_NUMBERS = frozenset(
    {"sigma_translation", "sigma_rotation", "reach"}
    | {"closure_sigma_translation", "closure_sigma_rotation"}
)

Progress = Callable[[str, int, int], None]


@on_host
def sweep(
    folder: str | os.PathLike[str],
    *,
    worlds: int,
    methods: Sequence[str] = METHODS,
    confidences: Sequence[float] = (0.99,),
    seed: int = 0,
    batch: int = 1_024,
    mesh: Mesh | None = None,
    progress: Progress | None = None,
    **world: Any,
) -> Path:
    """Runs methods at several gates on simulated worlds, and writes a row for each to Parquet.

    Columns of a row: `seed` and `world`, which name the world; `method`; `confidence`; `closures`
    and `inliers`, how many there are and how many of them are true; `accepted` and
    `accepted_inliers`, how many the method keeps and how many of those are true;
    `true_positive_rate`, `false_positive_rate` and `precision`, NaN where there is nothing to take
    a part of; `status`: "ok", or "not-finite" where some squared distance is no finite number and
    the row is not to be trusted.

    Rows depend on the seed, the world's number and its law alone: not on `worlds`, `batch`, the
    mesh, or how often the sweep was stopped.

    Args:
        folder: of the files, `worlds-….parquet`, each written whole or not at all; pyarrow, pandas
            and polars read the folder as one table. A call with equal arguments goes on from what
            is there, one with more worlds adds those. A kill costs one batch.
        worlds: how many, numbered from 0.
        methods: of `select_batched`; `"pcm-exact"` takes worlds of at most 128 closures,
            `"combinatorial"` of at most 32.
        confidences: probabilities inside the gates, see `chi2_gate`.
        seed: of `jax.random.key`.
        batch: worlds a file, rounded up to what fills the devices evenly.
        mesh: devices that share the worlds, of one process or of several that all make this call.
            Then the first process alone reads and writes the folder.
        progress: called with "sweep", the worlds done and the worlds in all after each batch.
        **world: the worlds' law, keyword arguments of `simulate_chains`.

    Returns:
        The folder.

    Raises:
        InputError: an argument out of range, an unknown method, a folder with rows of another
            sweep, or pyarrow is not installed.
    """
    _check_numbers(worlds, batch, seed)
    grid = _grid(methods, confidences, world)
    writes = mesh is None or not mesh.is_multi_process or jax.process_index() == 0
    files = SweepFiles(folder, grid.about(seed)) if writes else None
    done = files.done(worlds) if files else np.zeros(worlds, bool)
    if mesh is not None and mesh.is_multi_process:
        from jax.experimental.multihost_utils import broadcast_one_to_all

        done = np.asarray(broadcast_one_to_all(done))
    share = _share(grid, min(batch, worlds), mesh)
    program = _program(grid.shape, share, mesh)
    finished = int(done.sum())
    for start, stop in _missing(done, share * (1 if mesh is None else mesh.size)):
        found = program(np.int64(start), np.int64(seed), grid.numbers)
        outcomes = jax.tree.map(np.asarray, found)
        if files:
            files.write(start, stop, _columns(grid, seed, start, stop, outcomes))
        finished += stop - start
        if progress is not None:
            progress("sweep", finished, worlds)
    return Path(folder)


class Outcomes(NamedTuple):
    """The outcome of some worlds; `methods` and `confidences` as in the grid.

    Attributes:
        closures: int32 `[w]`, in all.
        inliers: int32 `[w]`, true ones.
        finite: bool `[w]`, whether all squared distances are finite.
        accepted: int32 `[w, methods, confidences]`, closures that the method keeps.
        accepted_inliers: int32, likewise, true ones among them.
        true_positive_rate: likewise.
        false_positive_rate: likewise.
        precision: likewise.
    """

    closures: Int[Array, " w"]
    inliers: Int[Array, " w"]
    finite: Bool[Array, " w"]
    accepted: Int[Array, "w methods confidences"]
    accepted_inliers: Int[Array, "w methods confidences"]
    true_positive_rate: Float[Array, "w methods confidences"]
    false_positive_rate: Float[Array, "w methods confidences"]
    precision: Float[Array, "w methods confidences"]


class Shape(NamedTuple):
    """All that a program is compiled for.

    Attributes:
        methods: names.
        law: arguments of `simulate_chains` that are no floating-point numbers, by name.
    """

    methods: tuple[str, ...]
    law: tuple[tuple[str, Any], ...]

    @property
    def closures(self) -> int:
        """In every world."""
        law = dict(self.law)
        return law["inliers"] + law["aliased_groups"] * law["aliased_size"] + law["random"]


class Numbers(NamedTuple):
    """All that a program is run with.

    Attributes:
        gates: float64 `[confidences]`, γ².
        law: the other arguments of `simulate_chains`, by name.
    """

    gates: Float[np.ndarray, " confidences"]
    law: dict[str, np.float64]


class Grid(NamedTuple):
    """Methods and gates that are run on every world, and the worlds' law."""

    confidences: tuple[float, ...]
    shape: Shape
    numbers: Numbers

    def about(self, seed: int) -> dict[str, Any]:
        """All that rows depend on, as JSON has it."""
        numbers = {name: float(value) for name, value in self.numbers.law.items()}
        law = {name: getattr(value, "__name__", value) for name, value in self.shape.law}
        methods, confidences = list(self.shape.methods), list(self.confidences)
        grid = {"methods": methods, "confidences": confidences}
        return {"format": _FORMAT, "seed": seed, **grid, **law, **numbers}


def outcomes_of(worlds: Int[Array, " w"], seed: Any, numbers: Numbers, shape: Shape) -> Outcomes:
    """The kernel: draws worlds by their numbers, and lets every method choose; safe under jit."""
    root = jax.random.key(seed, impl="threefry2x32")
    key = jax.vmap(functools.partial(jax.random.fold_in, root))(worlds)
    law = {**dict(shape.law), **numbers.law}
    drawn = jax.vmap(functools.partial(simulate_chains, **law))(key)
    squared = jax.vmap(squared_mahalanobis)(drawn.problem)
    inliers = drawn.is_true

    def kept(method: str) -> Bool[Array, "confidences w m"]:
        return jax.vmap(lambda gate: select_batched(squared, gate, method=method))(numbers.gates)

    # [methods, confidences, w, m]; what does not depend on the gate is computed once.
    accepted = jnp.stack([kept(method) for method in shape.methods])
    rates = true_positive_rate, false_positive_rate, precision
    each = (
        accepted.sum(axis=-1, dtype=jnp.int32),
        (accepted & inliers).sum(axis=-1, dtype=jnp.int32),
        *(rate(accepted, inliers) for rate in rates),
    )
    return Outcomes(
        jnp.full(len(worlds), inliers.shape[1], jnp.int32),
        inliers.sum(axis=1, dtype=jnp.int32),
        jnp.isfinite(squared).all(axis=(1, 2)),
        *(jnp.moveaxis(values, 2, 0) for values in each),
    )


@functools.lru_cache(maxsize=8)
def _program(
    shape: Shape, share: int, mesh: Mesh | None
) -> Callable[[Any, Any, Numbers], Outcomes]:
    """The outcomes of `share` consecutive worlds for each device, from a first one on; compiled."""

    def of_one(first: Any, seed: Any, numbers: Numbers, device: Any = 0) -> Outcomes:
        worlds = (first + device * share + jnp.arange(share)).reshape(-1, _block(shape))
        found = jax.lax.map(lambda block: outcomes_of(block, seed, numbers, shape), worlds)
        return jax.tree.map(lambda leaf: leaf.reshape(share, *leaf.shape[2:]), found)

    if mesh is None:
        return jax.jit(of_one)

    def of_each(first: Any, seed: Any, numbers: Numbers) -> Outcomes:
        return of_one(first, seed, numbers, jax.lax.axis_index(mesh.axis_names))

    whole, in_order = PartitionSpec(), PartitionSpec(mesh.axis_names)
    # Not checked: loops start from constants, which all devices share, and go on with their own.
    shared = jax.shard_map(of_each, mesh=mesh, in_specs=whole, out_specs=in_order, check_vma=False)
    return jax.jit(shared, out_shardings=NamedSharding(mesh, whole))


def _block(shape: Shape) -> int:
    """Worlds that a device works on together: the same for every call."""
    return max(1, min(_WORLDS, _ENTRIES // shape.closures**2))


def _share(grid: Grid, batch: int, mesh: Mesh | None) -> int:
    """Worlds of each device in a batch: whole blocks."""
    block = _block(grid.shape)
    return -(-batch // (block * (1 if mesh is None else mesh.size))) * block


def _missing(done: Bool[np.ndarray, " worlds"], batch: int) -> Iterator[tuple[int, int]]:
    """Runs of worlds that are not done, of at most `batch`."""
    edges = np.flatnonzero(np.diff(done, prepend=True, append=True))
    for first, end in edges.reshape(-1, 2).tolist():
        for start in range(first, end, batch):
            yield start, min(start + batch, end)


def _columns(
    grid: Grid, seed: int, start: int, stop: int, outcomes: Outcomes
) -> dict[str, np.ndarray]:
    """Rows by world, then method, then confidence."""
    count = stop - start
    shape = (count, len(grid.shape.methods), len(grid.confidences))

    def repeated(values: Any, axis: int) -> np.ndarray:
        aligned = np.expand_dims(values, tuple(k for k in range(3) if k != axis))
        return np.broadcast_to(aligned, shape).ravel()

    found = outcomes._asdict()
    status = np.where(found.pop("finite")[:count], "ok", "not-finite")
    of_worlds = {name: found.pop(name)[:count] for name in ("closures", "inliers")}
    return {
        "seed": np.full(count * shape[1] * shape[2], seed),
        "world": repeated(np.arange(start, stop), 0),
        "method": repeated(np.array(grid.shape.methods), 1),
        "confidence": repeated(np.array(grid.confidences), 2),
        **{name: repeated(values, 0) for name, values in of_worlds.items()},
        **{name: values[:count].ravel() for name, values in found.items()},
        "status": repeated(status, 0),
    }


def _grid(methods: Sequence[str], confidences: Sequence[float], world: dict[str, Any]) -> Grid:
    for method in methods:
        kernel_of(method, "methods", "some")
    if not len(methods) or not len(confidences):
        raise InputError("methods, confidences: expected one of each at least")
    parameters = inspect.signature(simulate_chains).parameters.values()
    law = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    for name in world:
        if name not in law:
            raise InputError(f"{name}: not an argument of a sweep, nor one of {', '.join(law)}")
    numbers = {name: np.float64({**law, **world}[name]) for name in law if name in _NUMBERS}
    require_positive(**numbers)
    fixed = {name: value for name, value in {**law, **world}.items() if name not in numbers}
    gates = np.asarray(chi2_gate(np.array(confidences), lie.tangent_dim(fixed["group"])))
    shape = Shape(tuple(methods), tuple(fixed.items()))
    return Grid(tuple(map(float, confidences)), shape, Numbers(gates, numbers))


def _check_numbers(worlds: int, batch: int, seed: int) -> None:
    if not 1 <= worlds <= _MOST_WORLDS:
        raise InputError(f"worlds: {worlds} given, expected 1 to {_MOST_WORLDS:,}")
    if batch < 1:
        raise InputError(f"batch: {batch} given, expected a world at least")
    if not -(2**63) <= seed < 2**63:
        raise InputError(f"seed: {seed} given, expected an integer of 64 bits")
