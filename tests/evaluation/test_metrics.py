"""Metrics: cases worked by hand, invariances, and SciPy as the oracle."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from pcm_jax import evaluation, lie
from pcm_jax.errors import InputError
from pcm_jax.evaluation import metrics
from pcm_jax.graph import PoseGraph
from pcm_jax.simulation import simulate_city

GROUPS = [jaxlie.SE2, jaxlie.SE3]


def planar(*rows):
    """Poses from (x, y, heading)."""
    x, y, heading = np.array(rows, dtype=float).T
    return lie.from_components(jaxlie.SE2, (np.cos(heading), np.sin(heading), x, y))


def random_poses(group, count, seed=0, scale=1.0):
    generator = np.random.default_rng(seed)
    return lie.exp(group, scale * generator.standard_normal((count, lie.tangent_dim(group))))


TRUTH = planar((0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, np.pi / 2))


def test_rates_of_a_small_selection():
    accepted = np.array([1, 1, 1, 0, 0, 0, 0], bool)
    inliers = np.array([1, 1, 0, 1, 1, 0, 0], bool)
    assert metrics.true_positive_rate(accepted, inliers) == pytest.approx(2 / 4)
    assert metrics.false_positive_rate(accepted, inliers) == pytest.approx(1 / 3)
    assert metrics.precision(accepted, inliers) == pytest.approx(2 / 3)


def test_rates_of_nothing_are_not_numbers():
    none, every = np.zeros(3, bool), np.ones(3, bool)
    assert np.isnan(metrics.true_positive_rate(every, none))
    assert np.isnan(metrics.false_positive_rate(every, every))
    assert np.isnan(metrics.precision(none, every))
    assert metrics.true_positive_rate(none, every) == 0.0


def test_rates_take_batches_lists_and_tracers():
    accepted = np.random.default_rng(0).random((5, 9)) < 0.5
    inliers = np.arange(9) < 4
    for rate in (metrics.true_positive_rate, metrics.false_positive_rate):
        one_by_one = [rate(list(row), inliers) for row in accepted]
        assert np.allclose(rate(accepted, inliers), one_by_one)
        assert np.allclose(jax.jit(jax.vmap(rate, (0, None)))(accepted, inliers), one_by_one)


def test_translation_errors_by_hand():
    estimate = planar((0, 0, 0), (1, 0, 0), (2, 3, 0), (2, 5, np.pi / 2))
    assert metrics.translation_mse(estimate, TRUTH) == pytest.approx((9 + 16) / 4)
    assert metrics.ate_rmse(estimate, TRUTH) == pytest.approx(2.5)


def test_rotation_error_is_the_mean_frobenius_norm_of_the_logarithm():
    estimate = planar((0, 0, 0), (1, 0, 0.1), (2, 0, -0.3), (2, 1, np.pi / 2))
    assert metrics.rotation_mse(estimate, TRUTH) == pytest.approx(np.sqrt(2) * 0.4 / 4)


@pytest.mark.parametrize("group", GROUPS)
def test_rotation_error_against_the_matrix_logarithm(group):
    truth, estimate = random_poses(group, 6, 1), random_poses(group, 6, 2)
    space = 2 if group is jaxlie.SE2 else 3
    left, right = (lie.as_matrix(poses)[:, :space, :space] for poses in (truth, estimate))
    norms = [np.linalg.norm(logm(a.T @ b)) for a, b in zip(left, right, strict=True)]
    assert metrics.rotation_mse(estimate, truth, align=None) == pytest.approx(np.mean(norms))


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("align", ["first", "umeyama"])
def test_the_frame_of_the_estimate_does_not_matter(group, align):
    truth, estimate = random_poses(group, 12, 3, 2.0), random_poses(group, 12, 4, 2.0)
    motion = random_poses(group, 1, 5, 3.0)
    before = metrics.pose_error(estimate, truth, align=align)
    after = metrics.pose_error(lie.compose(motion, estimate), truth, align=align)
    assert np.allclose(before, after, rtol=1e-9)
    perfect = metrics.pose_error(lie.compose(motion, truth), truth, align=align)
    assert np.allclose(perfect, 0.0, atol=1e-7)
    unaligned = metrics.pose_error(lie.compose(motion, truth), truth, align=None)
    assert min(unaligned) > 1e-2


@pytest.mark.parametrize("group", GROUPS)
def test_umeyama_agrees_with_scipy(group):
    truth, estimate = random_poses(group, 20, 6, 2.0), random_poses(group, 20, 7, 2.0)
    places = [np.zeros((20, 3)), np.zeros((20, 3))]
    for place, poses in zip(places, (truth, estimate), strict=True):
        position = lie.translation(poses)
        place[:, : position.shape[1]] = position - position.mean(axis=0)
    if group is jaxlie.SE3:
        _, distance = Rotation.align_vectors(*places)
    else:  # in the plane only the heading is free: the best angle in closed form
        turn = np.arctan2(np.cross(places[1], places[0])[:, 2].sum(), np.sum(places[0] * places[1]))
        turned = Rotation.from_euler("z", turn).apply(places[1])
        distance = np.linalg.norm(turned - places[0])
    mse = metrics.translation_mse(estimate, truth, align="umeyama")
    assert mse == pytest.approx(distance**2 / 20)
    assert mse < metrics.translation_mse(estimate, truth, align="first")


def test_umeyama_never_mirrors():
    mirrored = planar((0, 0, 0), (1, 0, 0), (2, 0, 0), (2, -1, -np.pi / 2))
    (moved,) = metrics.aligned(mirrored, TRUTH, align="umeyama")
    cos, sin, _, _ = lie.components(lie.between(lie.take(mirrored, 0), lie.take(mirrored, 3)))
    kept = lie.components(lie.between(lie.take(moved, 0), lie.take(moved, 3)))
    assert np.allclose(kept[:2], (cos, sin))
    assert metrics.translation_mse(mirrored, TRUTH, align="umeyama") > 0.01


def test_several_robots_are_moved_as_one():
    parts = (lie.take(TRUTH, np.s_[:2]), lie.take(TRUTH, np.s_[2:]))
    motion = planar((5, -3, 1.0))
    moved = [lie.compose(motion, part) for part in parts]
    assert metrics.translation_mse(moved, parts) == pytest.approx(0.0, abs=1e-20)
    one_robot_astray = [moved[0], lie.compose(planar((0, 2, 0)), moved[1])]
    assert metrics.translation_mse(one_robot_astray, parts) == pytest.approx(2.0)
    back = metrics.aligned(one_robot_astray, parts)
    assert np.allclose(lie.translation(back[0]), lie.translation(parts[0]))


def test_relative_errors_by_hand():
    # The second step is 0.5 m too long, the third turns 0.2 rad too little.
    estimate = planar((9, 9, 0), (10, 9, 0), (11.5, 9, 0), (11.5, 10, np.pi / 2 - 0.2))
    error = metrics.relative_pose_error(estimate, TRUTH)
    assert error.translation_mse == pytest.approx(0.25 / 3)
    assert error.rotation_mse == pytest.approx(np.sqrt(2) * 0.2 / 3)
    longer = metrics.relative_pose_error(estimate, TRUTH, delta=2)
    assert longer.translation_mse == pytest.approx((0.25 + 0.25) / 2)


@pytest.mark.parametrize("group", GROUPS)
def test_relative_errors_need_no_common_frame(group):
    truth = [random_poses(group, 7, 8), random_poses(group, 5, 9)]
    estimate = [random_poses(group, 7, 10), random_poses(group, 5, 11)]
    moved = [lie.compose(random_poses(group, 1, k), e) for k, e in enumerate(estimate)]
    assert np.allclose(
        metrics.relative_pose_error(estimate, truth), metrics.relative_pose_error(moved, truth)
    )
    counted = [metrics.relative_pose_error(e, t) for e, t in zip(estimate, truth, strict=True)]
    together = (6 * np.array(counted[0]) + 4 * np.array(counted[1])) / 10
    assert np.allclose(metrics.relative_pose_error(estimate, truth), together)


def test_raw_odometry_is_as_far_off_per_step_as_its_noise():
    world = simulate_city(
        seed=1, poses=3_000, robots=1, sigma_translation=0.05, sigma_rotation=0.03
    )
    error = metrics.relative_pose_error(world.graph.maps[0], world.truth[0])
    assert error.translation_mse == pytest.approx(2 * 0.05**2, rel=0.1)
    # Mean of |N(0, σ)| is σ √(2/π).
    assert error.rotation_mse == pytest.approx(np.sqrt(2) * 0.03 * np.sqrt(2 / np.pi), rel=0.1)


def test_relative_map_pose_by_hand():
    truth = [TRUTH, planar((4, 4, 0.0), (5, 4, 0.0)), planar((8, 0, 0.0))]
    astray = [TRUTH, planar((4, 7, 0.5), (0, 0, 0.0)), planar((8, 0, 0.0))]
    error = metrics.relative_map_pose_error(astray, truth)
    assert error.translation_mse == pytest.approx(9 / 2)
    assert error.rotation_mse == pytest.approx(np.sqrt(2) * 0.5 / 2)
    motion = planar((1, 2, 3.0))
    moved = [lie.compose(motion, poses) for poses in astray]
    assert np.allclose(metrics.relative_map_pose_error(moved, truth), error)


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_all_errors_can_be_jitted_and_mapped(group):
    truth, estimate = random_poses(group, 8, 1), random_poses(group, 8, 2)
    batch = lie.stack([estimate, random_poses(group, 8, 3)])

    def errors(poses):
        halves = [lie.take(poses, np.s_[:4]), lie.take(poses, np.s_[4:])]
        true = [lie.take(truth, np.s_[:4]), lie.take(truth, np.s_[4:])]
        return jnp.stack(
            [
                metrics.ate_rmse(poses, truth, align="umeyama"),
                metrics.rotation_mse(poses, truth),
                *metrics.relative_pose_error(poses, truth),
                *metrics.relative_map_pose_error(halves, true),
            ]
        )

    mapped = jax.jit(jax.vmap(errors))(lie.as_device(batch))
    assert mapped.shape == (2, 6)
    assert np.allclose(mapped[0], errors(estimate))
    assert not np.allclose(mapped[1], mapped[0])


def test_tracers_keep_their_precision():
    truth, estimate = (lie.as_device(random_poses(jaxlie.SE2, 5, k), np.float32) for k in (1, 2))
    assert jax.jit(metrics.ate_rmse)(estimate, truth).dtype == np.float32
    assert metrics.ate_rmse(estimate, truth).dtype == np.float64


def test_pose_graphs_are_taken_for_their_poses():
    graph = PoseGraph.from_trajectory(TRUTH, sigma_translation=0.1, sigma_rotation=0.1)
    assert metrics.translation_mse(graph, TRUTH) == pytest.approx(0.0)
    assert metrics.translation_mse([graph, graph], [TRUTH, graph]) == pytest.approx(0.0)


def test_normalized_chi2():
    assert metrics.normalized_chi2(30.0, 36, 6) == pytest.approx(1.0)
    assert np.isnan(metrics.normalized_chi2(30.0, 6, 6))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: metrics.ate_rmse(lie.take(TRUTH, np.s_[:3]), TRUTH), "estimate"),
        (lambda: metrics.ate_rmse(random_poses(jaxlie.SE3, 4), TRUTH), "estimate.*SE3"),
        (lambda: metrics.ate_rmse([TRUTH, TRUTH], TRUTH), "estimate"),
        (lambda: metrics.ate_rmse(TRUTH, TRUTH, align="best"), "align"),
        (lambda: metrics.relative_pose_error(TRUTH, TRUTH, delta=4), "delta"),
        (lambda: metrics.relative_pose_error(TRUTH, TRUTH, delta=0), "delta"),
        (lambda: metrics.relative_map_pose_error([TRUTH], [TRUTH]), "truth"),
    ],
)
def test_wrong_input_is_refused_by_name(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_the_folder_exports_every_metric():
    public = {
        name
        for name, value in vars(metrics).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == metrics.__name__
    }
    assert public - {"host_poses"} <= set(evaluation.__all__)
