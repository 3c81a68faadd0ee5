"""Settings every test shares: 64-bit arithmetic, quick compilation, where real data is.

Most of the suite's time is compilation. So programs are compiled with little optimisation, unless
`XLA_FLAGS` is set (`XLA_FLAGS= pytest` compiles as users do), and each one once: a folder for
compiled programs, of this run alone, is shared by its processes. BLAS has one thread, unless
`OPENBLAS_NUM_THREADS` is set: threads that wait for each other's tiny products take four times the
processor's time. All this holds for processes that tests start as well, and for notebooks.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import jax
import jaxlie
import pytest
import supply
from threadpoolctl import threadpool_limits

QUICK = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    " --xla_cpu_parallel_codegen_split_count=1"  # the workers share the cores already
)
CACHE = "JAX_COMPILATION_CACHE_DIR"
BLAS = "OPENBLAS_NUM_THREADS"
KEPT = {  # whatever its compilation took, and its size
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0.0,
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": -1,
}

os.environ.setdefault("XLA_FLAGS", QUICK)  # read with the first program
if BLAS not in os.environ:  # read where BLAS is loaded, which NumPy's is already
    os.environ[BLAS] = "1"
    threadpool_limits(1, user_api="blas")
if CACHE not in os.environ:  # else it is that of the process that started this one
    os.environ[CACHE] = tempfile.mkdtemp(prefix="compiled-")
    atexit.register(shutil.rmtree, os.environ[CACHE], ignore_errors=True)
os.environ |= {name: str(value) for name, value in KEPT.items()}
for name, value in {CACHE: os.environ[CACHE], **KEPT}.items():
    jax.config.update(name.lower(), value)  # a plugin may have imported JAX before
jax.config.update("jax_enable_x64", True)

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_report_header() -> list[str]:
    """Says what was installed otherwise than recorded, where pip left a report."""
    return supply.header()


@pytest.hookimpl(tryfirst=True)  # before pytest reads the markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the notebooks, which take longest, so that no worker is left with one."""
    notebooks = [item for item in items if item.path.suffix == ".ipynb"]
    for item in notebooks:
        item.add_marker("slow")
    items[:] = [*notebooks, *(item for item in items if item not in notebooks)]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A worker that is done takes tests from the others; each has its files' tests together."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


@pytest.fixture(params=[jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def group(request: pytest.FixtureRequest) -> type:
    """Both groups."""
    return request.param


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of public pose-graph files beside the checkout; skips where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(
            f"public pose-graph files not found at {SHARED_DATA} (they are not ours to ship)"
        )
    return SHARED_DATA
