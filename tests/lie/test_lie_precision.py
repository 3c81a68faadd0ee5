"""exp, log, Jacobians and adjoints against 40-digit arithmetic, at every size of angle."""

import jax
import jax.numpy as jnp
import jaxlie
import mpmath
import numpy as np
import pytest

from pcm_jax import lie

ANGLES = [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.2, 0.99, 1.01, 2.0, 3.0]
ANGLES += [np.pi - 1e-3, np.pi - 1e-6]
SIZES = [1.0, 1e3]
GROUPS = [jaxlie.SE2, jaxlie.SE3]
TOLERANCE = 1e-13


def tangents(group):
    """One tangent for every (translation size, angle), shape [sizes·angles, d]."""
    rng = np.random.default_rng(7)
    dimension = lie.tangent_dim(group)
    turning = 1 if group is jaxlie.SE2 else 3
    rows = []
    for size in SIZES:
        for angle in ANGLES:
            axis = rng.normal(size=turning)
            step = size * rng.uniform(-1, 1, size=dimension - turning)
            rows.append(np.concatenate([step, angle * axis / np.linalg.norm(axis)]))
    return np.array(rows)


def wedge(xi):
    """The Lie algebra element of a tangent vector, as a 40-digit matrix."""
    if len(xi) == 3:
        x, y, w = xi
        return mpmath.matrix([[0, -w, x], [w, 0, y], [0, 0, 0]])
    x, y, z, a, b, c = xi
    return mpmath.matrix([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


def vee(m):
    if m.rows == 3:
        return [m[0, 2], m[1, 2], m[1, 0]]
    return [m[0, 3], m[1, 3], m[2, 3], m[2, 1], m[0, 2], m[1, 0]]


def basis(dimension):
    return [wedge([mpmath.mpf(int(i == j)) for j in range(dimension)]) for i in range(dimension)]


def columns(vectors):
    return mpmath.matrix(
        [[vectors[j][i] for j in range(len(vectors))] for i in range(len(vectors))]
    )


def exact_parameters(xi):
    """cos and sin, or the quaternion, and the translation, in jaxlie's order."""
    matrix = mpmath.expm(wedge(xi))
    if len(xi) == 3:
        return [mpmath.cos(xi[2]), mpmath.sin(xi[2]), matrix[0, 2], matrix[1, 2]]
    angle = mpmath.sqrt(sum(w * w for w in xi[3:]))
    scale = mpmath.sin(angle / 2) / angle if angle else mpmath.mpf("0.5")
    quaternion = [mpmath.cos(angle / 2), *(scale * w for w in xi[3:])]
    return quaternion + [matrix[i, 3] for i in range(3)]


def exact_right_jacobian(xi):
    """Σ (−ad)ᵏ/(k+1)!, with ad from the commutators of the basis."""
    hat = wedge(xi)
    ad = columns([vee(hat * e - e * hat) for e in basis(len(xi))])
    total = term = mpmath.eye(len(xi))
    for k in range(1, 60):
        term = -term * ad / (k + 1)
        total = total + term
    return total


def exact_adjoint(xi):
    matrix, inverse = mpmath.expm(wedge(xi)), mpmath.expm(-wedge(xi))
    return columns([vee(matrix * e * inverse) for e in basis(len(xi))])


def as_float(values):
    return np.array(values.tolist() if isinstance(values, mpmath.matrix) else values, dtype=float)


@pytest.fixture(scope="module", params=GROUPS, ids=lambda group: group.__name__)
def reference(request):
    """The group, its tangents, and what 40 digits say of each."""
    group = request.param
    xi = tangents(group)
    with mpmath.workdps(40):
        exact = [[mpmath.mpf(float(value)) for value in row] for row in xi]
        jacobians = [exact_right_jacobian(row) for row in exact]
        return {
            "group": group,
            "tangent": xi,
            "parameters": np.array([as_float(exact_parameters(row)) for row in exact]),
            "adjoint": np.array([as_float(exact_adjoint(row)) for row in exact]),
            "right_jacobian": np.array([as_float(j) for j in jacobians]),
            "right_jacobian_inverse": np.array([as_float(j**-1) for j in jacobians]),
        }


def relative_error(found, expected):
    """Largest entry of the difference of each row, over the row's largest entry or one."""
    axes = tuple(range(1, np.ndim(expected)))
    scale = np.maximum(1.0, np.abs(expected).max(axis=axes))
    return np.abs(np.asarray(found, dtype=float) - expected).max(axis=axes) / scale


backends = pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray], ids=["numpy", "jax"])


@backends
def test_exp(reference, asarray):
    found = lie.parameters(lie.exp(reference["group"], asarray(reference["tangent"])))
    assert relative_error(found, reference["parameters"]).max() < TOLERANCE


@backends
def test_log(reference, asarray):
    transform = reference["group"](asarray(reference["parameters"]))
    assert relative_error(lie.log(transform), reference["tangent"]).max() < TOLERANCE


@backends
@pytest.mark.parametrize("name", ["right_jacobian", "right_jacobian_inverse"])
def test_jacobians(reference, asarray, name):
    found = getattr(lie, name)(reference["group"], asarray(reference["tangent"]))
    assert relative_error(found, reference[name]).max() < TOLERANCE


@backends
def test_adjoint(reference, asarray):
    transform = reference["group"](asarray(reference["parameters"]))
    assert relative_error(lie.adjoint(transform), reference["adjoint"]).max() < TOLERANCE


def test_log_of_the_negated_quaternion_is_the_same():
    xi = tangents(jaxlie.SE3)
    parameters = lie.parameters(lie.exp(jaxlie.SE3, xi)) * np.array([-1.0] * 4 + [1.0] * 3)
    assert relative_error(lie.log(jaxlie.SE3(parameters)), xi).max() < TOLERANCE


def test_log_at_half_a_turn():
    half_turn = jaxlie.SE3(np.array([0.0, 0.6, 0.0, 0.8, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(
        lie.log(half_turn)[3:], np.pi * np.array([0.6, 0.0, 0.8]), rtol=1e-15
    )
    np.testing.assert_allclose(
        lie.as_matrix(lie.exp(jaxlie.SE3, lie.log(half_turn))), lie.as_matrix(half_turn), atol=1e-14
    )
    half_turn = jaxlie.SE2(np.array([-1.0, 0.0, 1.0, 2.0]))
    np.testing.assert_allclose(lie.log(half_turn), [np.pi, -0.5 * np.pi, np.pi], atol=1e-15)


@backends
def test_float32_keeps_float32_accuracy(reference, asarray):
    group, small = reference["group"], np.float32
    tangent = asarray(reference["tangent"].astype(small))
    transform = group(asarray(reference["parameters"].astype(small)))
    # Near half a turn the rounded rotation may lie on the other side of it.
    near_pi = np.linalg.norm(reference["tangent"], axis=-1) > 3.1
    found = {
        "parameters": lie.parameters(lie.exp(group, tangent)),
        "tangent": lie.log(transform),
        "adjoint": lie.adjoint(transform),
        "right_jacobian": lie.right_jacobian(group, tangent),
        "right_jacobian_inverse": lie.right_jacobian_inverse(group, tangent),
    }
    for name, values in found.items():
        assert values.dtype == small, name
        error = relative_error(values, reference[name])
        if name == "tangent":
            error = error[~near_pi]
        assert error.max() < 3e-6, name


def test_jaxlie_itself_would_fail_here():
    """The reason for this module: the same tolerance is out of reach of jaxlie's own exp."""
    xi = tangents(jaxlie.SE3)
    ours = lie.parameters(lie.exp(jaxlie.SE3, xi))
    theirs = jaxlie.SE3.exp(jnp.asarray(xi)).parameters()
    assert relative_error(theirs, ours).max() > 1e3 * TOLERANCE


@pytest.mark.slow
def test_derivatives_are_finite_and_right_at_zero(reference):
    group = reference["group"]
    zero = jnp.zeros(lie.tangent_dim(group))

    def there_and_back(x):
        return lie.log(lie.exp(group, x))

    def derivatives(x):
        first = jax.jacfwd(there_and_back)(x), jax.jacrev(there_and_back)(x)
        return first, jax.jacfwd(jax.jacrev(there_and_back))(x)

    first, second = jax.jit(derivatives)(zero)
    for jacobian in first:
        np.testing.assert_allclose(jacobian, np.eye(len(zero)), atol=1e-15)
    np.testing.assert_allclose(second, 0.0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["right_jacobian", "right_jacobian_inverse"])
def test_second_derivatives_of_the_jacobians_are_finite_at_zero(reference, name):
    group = reference["group"]
    jacobian = lambda x: getattr(lie, name)(group, x)  # noqa: E731
    second = jax.jit(jax.jacfwd(jax.jacfwd(jacobian)))(jnp.zeros(lie.tangent_dim(group)))
    assert np.isfinite(second).all()
