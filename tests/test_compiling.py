"""NumPy while it is cheap, a compiled program from then on."""

import subprocess
import sys
import threading

import pytest

from pcm_jax.compiling import ALWAYS, KEPT, Thrift

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


def test_numpy_until_it_has_cost_as_much_as_compiling():
    thrift = Thrift(3.0)
    assert [thrift.compiles("a", 1.0) for _ in range(5)] == [False, False, False, True, True]
    assert not thrift.compiles("b", 3.0)  # an account of its own
    assert thrift.compiles("c", 3.5)  # at once


def test_always(monkeypatch):
    monkeypatch.setenv(ALWAYS, "always")
    assert Thrift(3.0).compiles("a", 0.0)


def test_accounts_are_bounded():
    thrift = Thrift(1.0)
    for key in range(3 * KEPT):
        thrift.compiles(key, 0.5)
    assert len(thrift._spent) == KEPT
    assert not thrift.compiles(0, 0.75)  # forgotten
    assert thrift.compiles(3 * KEPT - 1, 0.75)


def test_threads_share_an_account():
    thrift, answers = Thrift(400.0), []

    def work():
        answers.extend(thrift.compiles("a", 1.0) for _ in range(100))

    threads = [threading.Thread(target=work) for _ in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sum(answers) == 400


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["city", "sessions"])
def test_a_first_merge_compiles_nothing(kind):
    """A fresh process, as of somebody who types the first command."""
    run = [sys.executable, "-W", "ignore", "-c", FRESH.format(kind=kind)]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
