"""Entry points under other people's JAX settings: the same bits, in processes of their own.

The default (no 64-bit types), another default device, strict promotion, and JAX's NaN checks.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


SCRIPT = """
import contextlib, hashlib, sys
import jax
{settings}
import numpy as np
import pcm_jax as pcm
from pcm_jax.simulation import simulate_city

def digest(*trees):
    found = hashlib.blake2b(digest_size=8)
    for leaf in jax.tree.leaves(trees):
        array = np.asarray(leaf)
        found.update(repr((array.shape, array.dtype.str)).encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()

with {scope}:
    world = simulate_city(seed=1, poses=40, inliers=6, aliased_groups=0, random=4)
    graph = world.graph
    print("optimize", digest(pcm.optimize(graph.maps[0]).graph))
    print("marginals", digest(pcm.joint_marginal_covariance(graph.maps[0], np.array([3, 9]))))
    evidence = pcm.weigh(graph)
    print("weigh", digest(evidence.pairs[0].squared))
    print("select", digest(pcm.select(evidence).accepted))
    print("streamed", digest(pcm.select(graph, memory_limit=0).accepted))
    result = pcm.merge(evidence)
    print("merge", digest(result.graph, result.anchors, result.anchor_covariance))
    print("robust", digest(pcm.merge(evidence, method="gnc", initial="closures").graph))
    print("within", digest(pcm.select_within(graph.maps[0]).own_squared))
    print("clique", digest(pcm.maximum_clique(evidence.pairs[0].consistent(11.3)).members))
    maps = evidence.maps
    closures, _ = graph.closures.between(0, 1)
    problem = pcm.consistency_problem(*maps, closures)
    for kernel in ("closed-form", "jacfwd"):
        print(kernel, digest(pcm.squared_mahalanobis(problem, kernel=kernel)))
    soft = pcm.soft_select(pcm.squared_mahalanobis(problem), 11.3, temperature=1.0)
    print("soft", digest(soft))
    poses = pcm.merge_differentiable(evidence.optimized, result.accepted.astype(float))
    print("differentiable", digest(poses))
"""

SETTINGS = {
    "64 bits": ("jax.config.update('jax_enable_x64', True)", "contextlib.nullcontext()", {}),
    "the default": ("", "contextlib.nullcontext()", {}),
    "another device": (
        "",
        "jax.default_device(jax.devices()[3])",
        {"XLA_FLAGS": "--xla_force_host_platform_device_count=8"},
    ),
    "strict": (
        "jax.config.update('jax_numpy_dtype_promotion', 'strict');"
        "jax.config.update('jax_numpy_rank_promotion', 'raise')",
        "contextlib.nullcontext()",
        {},
    ),
    "nan checks": ("jax.config.update('jax_debug_nans', True)", "contextlib.nullcontext()", {}),
}


def outcomes(name: str) -> dict[str, str]:
    """What the script prints under some settings, by entry point."""
    settings, scope, environment = SETTINGS[name]
    flags = [os.environ.get("XLA_FLAGS", ""), environment.get("XLA_FLAGS", "")]
    environment = {**environment, "XLA_FLAGS": " ".join(flags).strip()}
    code = SCRIPT.replace("{settings}", settings).replace("{scope}", scope)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(line.split() for line in done.stdout.splitlines())


@pytest.fixture(scope="module")
def usual() -> dict[str, str]:
    return outcomes("64 bits")


@pytest.mark.parametrize("name", [name for name in SETTINGS if name != "64 bits"])
def test_the_same_bits_under_other_settings(usual, name):
    assert len(usual) == 13
    assert outcomes(name) == usual
