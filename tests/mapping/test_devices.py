"""Where the solver runs: on the CPU, whatever the default device and the caller's settings.

A program of its own, since a process has its devices once; and what is compiled for another
platform, which need not be there for that.
"""

import functools
import os
import pickle
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.compiling import ALWAYS
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.mapping import _callbacks, _gauss_newton, least_squares, optimize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.merging import merge_differentiable

pytestmark = pytest.mark.slow


PATIENCE = 400  # seconds, of a machine that is busy
BUFFERS, COPIES = "xla_buffer_python_cpu_callback", "xla_ffi_python_cpu_callback"
WEIGHTS = np.array([1.0, 0.5])
CODE = """
import contextlib, pickle, sys
from pathlib import Path
import jax
import numpy as np
import pcm_jax
from pcm_jax import lie

folder = Path(sys.argv[1])
away = jax.devices()[3]
def strict_and_away():
    scopes = contextlib.ExitStack()
    scopes.enter_context(jax.default_device(away))
    scopes.enter_context(jax.numpy_dtype_promotion("strict"))
    scopes.enter_context(jax.numpy_rank_promotion("raise"))
    scopes.enter_context(jax.debug_nans(True))
    return scopes

scopes = {"plain": contextlib.nullcontext, "strict": strict_and_away}
scopes["committed"] = contextlib.nullcontext

def answers(graph, weights):
    solution = pcm_jax.optimize(graph.maps[0])
    joint = pcm_jax.MapCovariance(solution.graph).joint(np.array([3, 5]), side="left")
    merged = pcm_jax.merge_differentiable(graph, weights)
    loss = lambda w: lie.parameters(pcm_jax.merge_differentiable(graph, w)[1]).sum()
    with jax.enable_x64(True):
        gradient = jax.grad(loss)(weights)
    assert {device for leaf in jax.tree.leaves(merged) for device in leaf.devices()} != {away}
    poses = [lie.parameters(each) for each in (solution.graph.poses, *merged)]
    return jax.tree.map(np.asarray, [solution.cost, joint, gradient, *poses])

given = pickle.loads((folder / "given.pickle").read_bytes())
with jax.enable_x64(True):
    committed = jax.tree.map(lambda leaf: jax.device_put(leaf, away), given)
found = {}
for setting, scope in scopes.items():
    with scope():
        found[setting] = answers(*(committed if setting == "committed" else given))
(folder / "found.pickle").write_bytes(pickle.dumps(found))
"""


@pytest.fixture(scope="module")
def world(make_map):
    """Two small maps at their optimum, and two closures between them."""
    maps = tuple(make_map(jaxlie.SE2, poses=9, loops=3, seed=k) for k in range(2))
    maps = tuple(optimize(one).graph for one in maps)
    ends = [lie.take(lie.as_numpy(one.poses), np.array([2, 7])) for one in maps]
    closures = LoopClosures.from_arrays(
        robot_a=[0, 0],
        pose_a=[2, 7],
        robot_b=[1, 1],
        pose_b=[2, 7],
        measurement=lie.between(*ends),
        information=np.broadcast_to(np.eye(3), (2, 3, 3)),
    )
    return MultiRobotGraph(maps, closures)


@pytest.fixture(scope="module")
def elsewhere(world, tmp_path_factory):
    """The answers in a process of eight devices without x64, by setting."""
    folder = tmp_path_factory.mktemp("eight")
    given = jax.tree.map(np.asarray, (world, WEIGHTS))
    (folder / "given.pickle").write_bytes(pickle.dumps(given))
    flags = os.environ.get("XLA_FLAGS", "")
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"} | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=8",
        ALWAYS: "always",
    }
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(folder)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return pickle.loads((folder / "found.pickle").read_bytes())


@pytest.mark.parametrize("setting", ["strict", "committed"])
def test_the_callers_device_and_settings_change_no_bit(elsewhere, setting):
    for found, expected in zip(elsewhere[setting], elsewhere["plain"], strict=True):
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, expected)


def called(text):
    return set(re.findall(r"custom_call @([\w$.]+)", text))


def problem_of(graph):
    """The arguments of the solver, for a small map."""
    edges = padded_edges(*host_arrays(graph), size=16)
    counts = np.array([graph.num_poses, graph.num_edges], np.int32)
    free = (np.arange(16) > 0) & (np.arange(16) < graph.num_poses)
    problem = _gauss_newton.Problem(edges, free, counts, np.asarray(10))
    return lie.pad_leading(lie.as_numpy(graph.poses), 16), problem


@pytest.mark.parametrize("solver", ["gauss-newton", "levenberg-marquardt"])
def test_on_a_cpu_the_solver_calls_back_without_copies(world, solver):
    options = {"solver": solver, "engine": "blocks", "rtol": 1e-9, "atol": 1e-9}
    traced = jax.jit(lambda *a: _gauss_newton.least_squares(*a, **options).value).trace(
        *problem_of(world.maps[0])
    )
    assert called(traced.lower().as_text()) == {BUFFERS}


def test_optimize_lowers_one_program_in_64_bits_for_the_cpu(world, monkeypatch):
    """Whatever the caller's own types are: here those of JAX's default, of 32 bits."""
    monkeypatch.setenv(ALWAYS, "always")
    lowered, compiled = [], least_squares._compiled

    def watched(*options):
        run = compiled(*options)

        def record(*arguments):
            text = run.trace(*arguments).lower().as_text()
            lowered.append((jax.config.jax_default_device, text))
            return run(*arguments)

        return record

    monkeypatch.setattr(least_squares, "_compiled", watched)
    with jax.enable_x64(False):
        assert optimize(world.maps[0]).converged
    ((device, text),) = lowered
    assert device.platform == "cpu"
    assert called(text) == {BUFFERS}
    assert "xf64>" in text
    assert "f32>" not in text


def stub(call, struct, *arguments, vmap_method):
    """In place of `jax.pure_callback`, which lowers only where its platform is present."""
    assert vmap_method == "sequential"
    return jax.lax.full(struct.shape, 31.25, struct.dtype)


def test_another_platform_is_called_back_by_copies(world, monkeypatch):
    monkeypatch.setattr(jax, "pure_callback", stub)

    def loss(weights):
        return jnp.sum(lie.parameters(merge_differentiable(world, weights)[1]))

    traced = jax.jit(jax.grad(loss)).trace(WEIGHTS)
    text = {
        platform: traced.lower(lowering_platforms=(platform,)).as_text()
        for platform in ("cpu", "cuda")
    }
    assert BUFFERS in text["cpu"]
    assert "3.125000e+01" not in text["cpu"]
    assert "callback" not in text["cuda"]
    assert "3.125000e+01" in text["cuda"]


@pytest.mark.parametrize("batched", [False, True])
def test_both_ways_give_the_same_bits(monkeypatch, batched):
    def body(out, a, b):
        assert all(type(each) is np.ndarray for each in (out, a, b))
        out[...] = a @ b

    def product(a, b):
        return _callbacks.call_host(body, jax.ShapeDtypeStruct((3, 3), np.float64), a, b)

    given = np.random.default_rng(0).normal(size=(2, 5, 3, 3) if batched else (2, 3, 3))
    run = jax.vmap(product) if batched else product
    expected = jax.jit(run)(*given)
    copies = lambda *arguments, cpu, default: default(*arguments)  # noqa: E731
    monkeypatch.setattr(_callbacks.jax.lax, "platform_dependent", copies)
    lowered = jax.jit(functools.partial(run)).trace(*given).lower()
    assert called(lowered.as_text()) == {COPIES}
    np.testing.assert_array_equal(lowered.compile()(*given), expected)
    np.testing.assert_array_equal(expected, given[0] @ given[1])
