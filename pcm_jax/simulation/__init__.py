"""Worlds with known truth: the paper's one-dimensional one, a city, and sessions in 3D.

    _one_dimensional  the paper's world of measurements on a line, thousands at once
    _streets          drives along the streets of a grid, in NumPy
    measurements      noisy relative poses, and who meets whom
    outliers          false closures: aliased groups and random ones
    world             maps, closures and labels put together; clutter for maps of one's own
    _false_loops      false closures inside one robot's map, by the four laws of races
    _city             robots in one city, SE(2)
    _sessions         drives over one campus, SE(3)
    _town             drives through a town as a kernel
    _chains           two odometry chains and their closures as a kernel, worlds by the thousand

But for the kernels all of it runs on the host in NumPy, and is reproducible: one
`numpy.random.default_rng(seed)` draws everything.
"""

from pcm_jax.simulation._chains import ChainWorld, simulate_chains
from pcm_jax.simulation._city import simulate_city
from pcm_jax.simulation._false_loops import LAWS, SpoiledMap, add_false_loops
from pcm_jax.simulation._one_dimensional import OneDimensionalWorlds, simulate_one_dimensional
from pcm_jax.simulation._sessions import simulate_sessions
from pcm_jax.simulation.world import SimulatedWorld, add_clutter

__all__ = [
    "LAWS",
    "ChainWorld",
    "OneDimensionalWorlds",
    "SimulatedWorld",
    "SpoiledMap",
    "add_clutter",
    "add_false_loops",
    "simulate_chains",
    "simulate_city",
    "simulate_one_dimensional",
    "simulate_sessions",
]
