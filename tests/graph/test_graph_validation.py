import numpy as np
import pytest

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.text import line_fault
from pcm_jax.graph import symbols
from pcm_jax.graph.validation import (
    argument_fault,
    clip_to_definite,
    positive_definite,
    unit_rotations,
)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_positive_definite_agrees_with_eigenvalues(rng, d):
    root = rng.normal(size=(300, d, d))
    matrices = 0.5 * (root + np.swapaxes(root, 1, 2)) + rng.uniform(-1, 3, (300, 1, 1)) * np.eye(d)
    expected = np.linalg.eigvalsh(matrices)[:, 0] > 0.0
    assert 0 < expected.sum() < 300
    np.testing.assert_array_equal(positive_definite(matrices), expected)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([1.0, 0.0, 1.0]), -np.eye(3)])
def test_semidefinite_is_not_definite(matrix):
    assert not positive_definite(matrix[None])[0]


def test_nearly_singular_is_definite():
    assert positive_definite(np.diag([1.0, 4.0, 1.5e-9])[None])[0]


@pytest.mark.parametrize(("size", "value"), [(4, 1e200), (2, 1e155), (4, 0.0)])
def test_rotations_without_a_norm_are_refused(size, value):
    rows = np.stack([np.eye(size + 2)[0], np.full(size + 2, value)])
    fault = line_fault("a.bag", np.array([1, 2]))
    with pytest.raises(FileFormatError, match=r"a\.bag:2: .* of norm (inf|0), expected norm 1"):
        unit_rotations(rows, size, fault)


def test_clip_touches_only_what_has_no_factor(rng):
    vectors = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    values = np.array([-5.0, -1e-3, 1e-3, 1.0, 10.0, 100.0])
    bad = (vectors * values) @ vectors.T
    good = np.diag([1e-12, 1.0, 1.0, 1.0, 1.0, 1.0])
    clipped, count = clip_to_definite(np.stack([good, bad, good]))
    assert count == 1
    np.testing.assert_array_equal(clipped[[0, 2]], np.stack([good, good]))
    expected = np.sort(np.maximum(values, 1e-9 * 100.0))
    np.testing.assert_allclose(np.linalg.eigvalsh(clipped[1]), expected, rtol=1e-6, atol=1e-13)
    assert positive_definite(clipped).all()


def test_symbol_keys():
    ids = np.array([(ord("a") << 56) | 5, (ord("~") << 56) | (2**56 - 1), 17, -4, 31 << 56])
    assert [chr(code) if code else "" for code in symbols.letters_of(ids)] == ["a", "~", "", "", ""]
    assert symbols.indices_of(ids).tolist() == [5, 2**56 - 1, 17, -4, 31 << 56]
    assert symbols.keys("a", np.array([5])).tolist() == [ids[0]]
    assert symbols.are_symbols(ids[:2])
    assert not symbols.are_symbols(ids)
    assert not symbols.are_symbols(ids[:0])


def test_a_quaternion_that_is_no_number_is_refused():
    rows = np.array([[1.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"q\[1\]: quaternion of norm nan, expected norm 1"):
        unit_rotations(rows, 4, argument_fault("q"))


def test_what_has_no_eigenvalues_is_left_to_be_refused(monkeypatch):
    def unsolved(matrices):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", unsolved)
    matrices = -np.eye(3)[None]
    found, clipped = clip_to_definite(matrices)
    assert found is matrices
    assert clipped == 0
