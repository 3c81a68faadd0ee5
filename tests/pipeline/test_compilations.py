"""Robot pairs of different sizes share compilations."""

import jax
import numpy as np
import pytest

from pcm_jax.compiling import ALWAYS
from pcm_jax.pipeline import merge
from pcm_jax.simulation import simulate_city

COMPILED: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, fun_name="", **__: (
        COMPILED.append(fun_name) if event.endswith("backend_compile_duration") else None
    )
)


@pytest.mark.slow
def test_ten_robot_pairs_compile_once_or_twice(monkeypatch):
    """Every program of a merge, for ten pairs of 60 to 240 poses and 9 to 60 closures."""
    monkeypatch.setenv(ALWAYS, "always")
    rng = np.random.default_rng(0)
    worlds = [
        simulate_city(
            seed=seed,
            poses=int(poses),
            inliers=int(rng.integers(4, 20)),
            aliased_groups=1,
            aliased_size=3,
            random=int(rng.integers(2, 37)),
        )
        for seed, poses in enumerate(np.linspace(60, 240, 10))
    ]
    COMPILED.clear()
    with jax.default_matmul_precision("float32"):  # nothing else does, so all is compiled anew
        for world in worlds:
            assert merge(world.graph).solution.converged
    counts = {name: COMPILED.count(name) for name in set(COMPILED)}
    # The maps' and the merged map's solves are one program, at two sizes each.
    assert counts.pop("jit(solve_poses)") <= 3
    assert all(count <= 2 for count in counts.values()), counts
