"""Settings every test shares: 64-bit arithmetic, quick compilation, where real data is.

Most of the suite's time is compilation. So programs are compiled with little optimisation, unless
`XLA_FLAGS` is set (`XLA_FLAGS= pytest` compiles as users do), and each one once: a folder for
compiled programs, of this run alone, is shared by its processes. Both hold for processes that tests
start as well, and for notebooks. What must see usual optimisation asks for it: `compiled_as_usual`.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

QUICK = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", QUICK)  # read when JAX starts its first program
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # else of the process that started this one
    programs = tempfile.mkdtemp(prefix="compiled-")
    atexit.register(shutil.rmtree, programs, ignore_errors=True)
    os.environ |= {
        "JAX_COMPILATION_CACHE_DIR": programs,  # read on JAX's import
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }

import jax  # noqa: E402
import jaxlie  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


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
