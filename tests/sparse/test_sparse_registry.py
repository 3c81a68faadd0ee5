"""The owner of what is kept: bounded, safe in threads, and BLAS's threads left to the user."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pcm_jax.sparse import _memory, cholesky, registry
from pcm_jax.sparse._blas import BlasThreads
from pcm_jax.sparse._memory import SpareMemory
from pcm_jax.sparse.inverse import inverse_block
from pcm_jax.sparse.system import system_for

PATIENCE = 30  # seconds, for a thread that should have been let in


def threads_of_blas() -> set[int]:
    from threadpoolctl import ThreadpoolController

    pools = ThreadpoolController().select(user_api="blas")
    return {pool.num_threads for pool in pools.lib_controllers}


@pytest.fixture
def two_by_the_user():
    """A user who allows BLAS two threads."""
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    with threadpool_limits(2, user_api="blas"):
        if threads_of_blas() != {2}:
            pytest.skip("this BLAS has no threads")
        yield


def test_scopes_overlap_and_the_last_one_restores(two_by_the_user):
    """The first to enter leaves first: each putting back what it found would leave one thread."""
    blas = BlasThreads()
    first, second = blas.one(), blas.one()
    entered, left = threading.Event(), threading.Event()

    def other():
        with second:
            entered.set()
            assert left.wait(PATIENCE)
            assert threads_of_blas() == {1}

    with ThreadPoolExecutor(1) as pool:
        with first:
            running = pool.submit(other)
            assert entered.wait(PATIENCE)
        left.set()
        running.result()
    assert threads_of_blas() == {2}


def test_many_threads_of_blas_run_beside_nobody(two_by_the_user):
    blas, inside, seen = BlasThreads(), [], []
    guard = threading.Barrier(4)

    def work(number):
        guard.wait(PATIENCE)
        for _ in range(20):
            with blas.one():
                with blas.one():
                    seen.append(threads_of_blas())
                with blas.many(number % 2 == 0):
                    inside.append(number)
                    if number % 2 == 0:
                        others = list(inside)
                        assert threads_of_blas() == {2}
                        assert list(inside) == others
                    inside.remove(number)
                seen.append(threads_of_blas())

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert set().union(*seen) == {1}
    assert threads_of_blas() == {2}


def test_an_error_leaves_the_users_setting(two_by_the_user):
    blas = BlasThreads()
    with pytest.raises(ZeroDivisionError), blas.one(), blas.many():
        raise ZeroDivisionError
    assert threads_of_blas() == {2}
    with blas.one():
        assert threads_of_blas() == {1}


def test_memory_is_used_again_and_given_back():
    spare = SpareMemory()
    with spare.borrow(100) as memory:
        assert spare.nbytes == 0
    assert spare.nbytes == 800
    with spare.borrow(10) as again:
        assert np.shares_memory(again, memory)
        with spare.borrow(10) as other:
            assert not np.shares_memory(other, memory)
    spare.free()
    assert spare.nbytes == 0
    with spare.borrow(5):
        pass
    with spare.borrow(5, last=True):
        pass
    assert spare.nbytes == 0


def test_memory_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(_memory, "MOST", 2)
    spare = SpareMemory()
    scopes = [spare.borrow(10) for _ in range(5)]
    for scope in scopes:
        scope.__enter__()
    for scope in scopes:
        scope.__exit__(None, None, None)
    assert spare.nbytes == 160


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    index = np.arange(side * side).reshape(side, side)
    tail = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    return tail, np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])


def test_eight_threads_factorise_as_one_does(monkeypatch, two_by_the_user):
    """Bit for bit, large fronts among them, which BLAS shares out over its own threads."""
    monkeypatch.setattr(cholesky, "LARGE_FRONT", 40)
    tail, head = grid(14)
    fixed = np.arange(196) == 0
    products = [np.random.default_rng(k).uniform(0.9, 1.1, (3, len(tail), 1, 1)) for k in range(8)]
    for each in products:
        each[2] = -np.sqrt(each[0] * each[1]) * 0.99
    wanted = np.arange(0, 196, 3)

    def answer(each):
        system = system_for(196, tail, head, fixed, 1)
        with registry.spare.borrow(system.plan.scalars) as memory:
            return inverse_block(system.factorize(each, 0.0, memory), wanted)

    expected = [answer(each) for each in products]
    registry.systems.clear()
    registry.plans.clear()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(answer, products * 4))
    np.testing.assert_array_equal(found, expected * 4)
    registry.spare.free()
    assert threads_of_blas() == {2}


def test_what_is_forgotten_is_made_again():
    tail, head = grid(3)
    fixed = np.arange(9) == 0
    system = system_for(9, tail, head, fixed, 3)
    assert system_for(9, tail.astype(np.int32), head, fixed, 3) is system
    assert system_for(9, tail, head, ~fixed, 3) is not system
    registry.systems.clear()
    again = system_for(9, tail, head, fixed, 3)
    assert again is not system
    assert again.plan is system.plan


def test_a_system_keeps_no_buffer_of_its_caller():
    """A callback's arrays are gone after it."""
    tail, head = (end.copy() for end in grid(3))
    system = system_for(9, tail, head, np.arange(9) == 1, 3)
    assert not any(
        np.shares_memory(own, end) for own in (system.tail, system.head) for end in (tail, head)
    )
