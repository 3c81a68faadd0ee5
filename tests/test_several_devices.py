"""Past one device: Q by rows and sweeps by worlds, the same numbers however many there are.

Eight devices of one process, and two processes joined over loopback, each a program of its own; and
what is compiled for a GPU, of which none is needed for that, never calls back to the host.
"""

import os
import pickle
import re
import signal
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pyarrow.parquet
import pytest
from jax.sharding import Mesh

import pcm_jax
from pcm_jax.clique import maximum_clique_batched
from pcm_jax.errors import InputError
from pcm_jax.experiments.sweep import Grid, Numbers, Shape, outcomes_of
from pcm_jax.simulation import simulate_chains

pytestmark = pytest.mark.slow


PATIENCE = 240  # seconds, of a machine that is busy
LAW = {"poses": 30, "inliers": 4, "aliased_groups": 1, "aliased_size": 3, "random": 5}
SWEEP = {"worlds": 600, "methods": ("ransac", "scgp"), "confidences": (0.5, 0.99), **LAW}
CODE = f"""
import os, pickle, signal, sys
from pathlib import Path
import jax
import numpy as np
from jax.sharding import Mesh
import pcm_jax

jax.config.update("jax_enable_x64", True)
folder, address, count, number, killed = Path(sys.argv[1]), *sys.argv[2:]
if int(count) > 1:
    jax.distributed.initialize(address, num_processes=int(count), process_id=int(number))
problem = pickle.loads((folder / "problem.pickle").read_bytes())
mesh = Mesh(np.array(jax.devices()), ("all",))
squared = pcm_jax.squared_mahalanobis(problem, mesh=mesh)
for shard in squared.addressable_shards:
    np.save(folder / f"rows-{{shard.index[0].start or 0:03d}}.npy", shard.data)
kill = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
progress = kill if killed == "killed" else None
pcm_jax.sweep(folder / "sweep", batch=128, mesh=mesh, progress=progress, **{SWEEP})
"""


def start(folder, address="", count=1, number=0, devices=1, killed=""):
    flags = os.environ.get("XLA_FLAGS", "")
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count={devices}",
    }
    arguments = [str(folder), address, str(count), str(number), killed]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen(
        [sys.executable, "-c", CODE, *arguments], env=environment, text=True, **pipes
    )


def finish(*processes):
    """Their exit codes, and what they said."""
    try:
        said = [process.communicate(timeout=PATIENCE)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], "\n".join(said)


@pytest.fixture(scope="module")
def problem():
    draw = jax.jit(lambda key: simulate_chains(key, **LAW).problem)
    return jax.tree.map(np.asarray, draw(jax.random.key(1)))


@pytest.fixture(scope="module")
def squared(problem):
    """Q of one device, without a mesh."""
    return np.asarray(pcm_jax.squared_mahalanobis(problem))


@pytest.fixture
def folder(tmp_path, problem):
    """What the processes read, and write to."""
    (tmp_path / "problem.pickle").write_bytes(pickle.dumps(problem))
    return tmp_path


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The sweep of one device, without a mesh, all at once."""
    folder = tmp_path_factory.mktemp("alone")
    return pyarrow.parquet.read_table(pcm_jax.sweep(folder, batch=64, **SWEEP))


def check_rows(folder, squared, padded):
    rows = np.concatenate([np.load(path) for path in sorted(folder.glob("rows-*.npy"))])
    assert rows.shape == (padded, padded)
    m = len(squared)
    np.testing.assert_allclose(rows[:m, :m], squared, rtol=1e-12)
    off_diagonal = ~np.eye(padded, dtype=bool)
    off_diagonal[:m, :m] = False
    assert np.isinf(rows[off_diagonal]).all()


def test_eight_devices_killed_and_gone_on_with_on_one(folder, squared, alone):
    codes, said = finish(start(folder, devices=8, killed="killed"))
    assert codes == [-signal.SIGKILL], said
    check_rows(folder, squared, padded=16)  # 12 closures
    (part,) = (folder / "sweep").glob("*.parquet")
    assert part.name == "worlds-0000000000-0000000512.parquet"  # a block of 64 for each device
    pcm_jax.sweep(folder / "sweep", batch=64, **SWEEP)
    assert len(list((folder / "sweep").glob("*.parquet"))) == 3
    assert pyarrow.parquet.read_table(folder / "sweep").equals(alone)


@pytest.mark.skipif(sys.platform == "win32", reason="jaxlib joins no CPU processes on Windows")
def test_two_processes_joined_over_loopback(folder, squared, alone):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    codes, said = finish(*(start(folder, address, count=2, number=k) for k in (0, 1)))
    assert codes == [0, 0], said
    assert len(list(folder.glob("rows-*.npy"))) == 2
    check_rows(folder, squared, padded=12)
    assert len(list((folder / "sweep").glob("*.parquet"))) == 5
    assert pyarrow.parquet.read_table(folder / "sweep").equals(alone)


def test_a_mesh_inside_jit(problem, squared):
    mesh = Mesh(np.array(jax.devices()[:1]).reshape(1, 1), ("hosts", "devices"))
    found = jax.jit(lambda one: pcm_jax.squared_mahalanobis(one, mesh=mesh))(problem)
    np.testing.assert_allclose(found, squared, rtol=1e-12)


def test_a_mesh_with_the_definition(problem):
    mesh = Mesh(np.array(jax.devices()[:1]), ("all",))
    with pytest.raises(InputError, match="mesh: given with kernel 'jacfwd'"):
        pcm_jax.squared_mahalanobis(problem, mesh=mesh, kernel="jacfwd")


def lowered(function, argument, platform):
    traced = jax.jit(function).trace(argument)
    return traced.lower(lowering_platforms=(platform,)).as_text()


def sweep_kernel(worlds):
    law = (("group", jaxlie.SE2), *LAW.items())
    shape = Shape(("pcm-heuristic", "ransac", "scgp", "pcm-exact"), law)
    grid = Grid((0.5, 0.99), shape, Numbers(np.array([2.4, 11.3]), {}))
    return outcomes_of(worlds, 0, grid.numbers, grid.shape)


@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (lambda key: pcm_jax.squared_mahalanobis(simulate_chains(key, **LAW).problem), None),
        (maximum_clique_batched, jax.ShapeDtypeStruct((5, 40, 40), bool)),
        (sweep_kernel, jax.ShapeDtypeStruct((8,), np.int64)),
    ],
    ids=["squared_mahalanobis", "maximum_clique_batched", "sweep"],
)
def test_what_runs_on_a_gpu_does_not_call_back(function, shape):
    """A factorisation by cuSOLVER is all that is called by name."""
    text = lowered(function, jax.random.key(0) if shape is None else shape, "cuda")
    called = set(re.findall(r"custom_call @([\w$.]+)", text))
    assert called <= {"cusolver_syevd_ffi", "cu_threefry2x32_ffi"}
    assert "callback" not in text


def test_a_callback_would_be_seen():
    text = lowered(lambda x: jax.pure_callback(lambda y: y, x, x), jnp.ones(3), "cpu")
    assert "callback" in text
