"""Settings every test shares: 64-bit arithmetic, and where real data is looked for."""

from pathlib import Path

import jax
import jaxlie
import pytest

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
