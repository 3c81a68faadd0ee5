"""NumPy where it is cheap, a compiled program elsewhere."""

import subprocess
import sys

import pytest

from pcm_jax.compiling import ALWAYS, is_worth_compiling

FRESH = """
import logging, jax
import pcm_jax as pcm
from pcm_jax.simulation import simulate_{kind}
compiled = []
class Keep(logging.Handler):
    def emit(self, record):
        if "Compiling" in record.getMessage():
            compiled.append(record.getMessage().split()[1])
jax.config.update("jax_log_compiles", True)
logger = logging.getLogger("jax")
logger.addHandler(Keep())
logger.propagate = False
world = simulate_{kind}(seed=0, poses=40, inliers=8, aliased_groups=0, random=12)
before = len(compiled)
result = pcm.merge(world.graph)
assert result.groups == ((0, 1),), result
print(compiled[before:])
"""


def test_the_size_alone_decides():
    answers = [is_worth_compiling(seconds) for seconds in (2.9, 2.9, 3.1, 2.9)]
    assert answers == [False, False, True, False]  # however much was done before


def test_always(monkeypatch):
    monkeypatch.setenv(ALWAYS, "always")
    assert is_worth_compiling(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["city", "sessions"])
def test_a_first_merge_compiles_nothing(kind):
    """A fresh process, as of somebody who types the first command."""
    run = [sys.executable, "-W", "ignore", "-c", FRESH.format(kind=kind)]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
