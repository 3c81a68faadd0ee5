"""Worlds with known truth: the paper's one-dimensional one, a city, and sessions in 3D.

These run on the host in NumPy, and are reproducible: one `numpy.random.default_rng(seed)` draws all
of it. `simulate_chains` is a kernel: worlds by the thousand inside a compiled program.
"""

from pcm_jax.simulation.chains import ChainWorld, simulate_chains
from pcm_jax.simulation.city import simulate_city
from pcm_jax.simulation.one_dimensional import OneDimensionalWorlds, simulate_one_dimensional
from pcm_jax.simulation.sessions import simulate_sessions
from pcm_jax.simulation.world import SimulatedWorld, add_clutter

__all__ = [
    "ChainWorld",
    "OneDimensionalWorlds",
    "SimulatedWorld",
    "add_clutter",
    "simulate_chains",
    "simulate_city",
    "simulate_one_dimensional",
    "simulate_sessions",
]
