"""Arrays and derivatives cross to other libraries by DLPack, without a copy; PyTorch included."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pcm_jax as pcm
from pcm_jax.selection import soft

GATE = 11.3


def distances():
    rng = np.random.default_rng(0)
    squared = rng.chisquare(3, (12, 12))
    squared[6:] = squared[:, 6:] = 40.0
    squared[0, 1] = GATE - 1.0
    return squared


def test_numpy_reads_results_where_they_lie():
    weights = pcm.soft_select(distances(), GATE, temperature=1.0)
    seen = np.from_dlpack(weights)
    np.testing.assert_array_equal(seen, weights)
    assert seen.ctypes.data == weights.unsafe_buffer_pointer()


@pytest.mark.slow
def test_derivatives_there_and_back():
    """What a foreign library's backward pass does: pull its own cotangent back."""
    run = lambda q: pcm.soft_select(q, GATE, temperature=1.0)  # noqa: E731
    squared, pull = distances(), np.random.default_rng(1).normal(size=12)
    weights, back = jax.vjp(run, jnp.from_dlpack(squared))
    (slope,) = back(jnp.from_dlpack(pull))
    expected = jax.grad(lambda q: jnp.vdot(pull, run(q)))(squared)
    np.testing.assert_array_equal(np.from_dlpack(slope), expected)
    assert np.abs(expected).max() > 1e-3
    assert weights.dtype == squared.dtype


def test_pytorch_as_the_docstring_says():
    torch = pytest.importorskip("torch", reason="PyTorch is not installed; a docstring uses it")
    (block,) = re.findall(r"^```python\n(import torch\n.*?)^```$", soft.__doc__, re.M | re.S)
    names = {"jax": jax, "pcm": pcm, "gate": GATE}
    exec(compile(block, soft.__file__, "exec"), names)
    squared = torch.tensor(distances(), requires_grad=True)
    pull = np.random.default_rng(1).normal(size=12)
    weights = names["SoftSelect"].apply(squared)
    weights.backward(torch.tensor(pull))
    run = lambda q: jnp.vdot(pull, pcm.soft_select(q, GATE, temperature=1.0))  # noqa: E731
    np.testing.assert_allclose(squared.grad.numpy(), jax.grad(run)(distances()), rtol=1e-12)
