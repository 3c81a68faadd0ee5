"""What the page draws and tells of every closure, against the merge itself."""

import base64

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.integrity import STANDINGS, way_of
from pcm_jax.report import _drawings as drawing
from pcm_jax.report import page
from pcm_jax.report._drawings import drawings
from pcm_jax.report._facts import FATES, facts_of
from pcm_jax.report._words import counted, listed, more, number


@pytest.fixture(scope="module", params=["SE2", "SE3"])
def merged(request, result, spatial):
    return result if request.param == "SE2" else spatial


@pytest.fixture(scope="module")
def facts(merged):
    return facts_of(merged)


@pytest.fixture(scope="module")
def drawn(merged, facts):
    return drawings(merged, facts)


def distances(pair):
    """The bytes as a symmetric matrix."""
    n = len(pair["closures"])
    levels = np.zeros((n, n), int)
    found = np.frombuffer(base64.b64decode(pair["distances"]), np.uint8)
    levels[np.triu_indices(n, 1)] = found
    return levels + levels.T


def test_closures_under_128_agree_and_no_others(merged, drawn):
    (pair,), (chosen,) = drawn["pairs"], merged.selection.pairs
    order = np.searchsorted(chosen.closures, pair["closures"])
    graph = chosen.consistent()[np.ix_(order, order)]
    assert (graph.sum() > 30) and not graph.all()
    np.testing.assert_array_equal((distances(pair) < 128) & ~np.eye(len(order), dtype=bool), graph)


def test_distances_are_multiples_of_the_gate(merged, drawn):
    (pair,), (chosen,) = drawn["pairs"], merged.selection.pairs
    order = np.searchsorted(chosen.closures, pair["closures"])
    both = np.maximum(chosen.squared, chosen.squared.T)[np.ix_(order, order)]
    times, levels = np.sqrt(both / chosen.gate), distances(pair)
    off = ~np.eye(len(order), dtype=bool)
    near, far = off & (levels < 128), off & (levels > 128) & (levels < 255)
    np.testing.assert_allclose(levels[near] / 127, times[near], atol=1 / 127)
    np.testing.assert_allclose(2 ** ((levels[far] - 128) / 12), times[far], rtol=0.07)


def test_the_matrix_is_in_the_order_of_places(merged, drawn):
    (pair,), closures = drawn["pairs"], merged.candidates
    ahead = np.where(np.asarray(closures.robot_a) == 0, closures.pose_a, closures.pose_b)
    way = way_of(merged.maps[0])[ahead]
    assert (np.diff(way[pair["closures"]]) >= 0).all()
    assert sorted(pair["closures"]) == list(range(len(closures)))


def test_sets_are_marked(merged, drawn):
    (pair,), (chosen,) = drawn["pairs"], merged.selection.pairs
    shown = np.asarray(pair["closures"])
    assert sorted(shown[pair["members"]]) == np.flatnonzero(merged.accepted).tolist()
    rival = chosen.verdict.rival
    expected = [] if rival is None else chosen.closures[rival.members].tolist()
    assert sorted(shown[pair["rival"]].tolist()) == expected


def test_too_many_closures_are_thinned_and_sets_kept(merged, monkeypatch):
    monkeypatch.setattr(drawing, "MOST_CLOSURES", 14)
    (pair,) = drawings(merged, facts_of(merged))["pairs"]
    assert len(pair["closures"]) <= 14
    assert pair["left_out"] == len(merged.candidates) - len(pair["closures"])
    assert set(np.flatnonzero(merged.accepted)) <= set(pair["closures"])


def test_positions_are_kept_to_half_a_unit(merged, drawn):
    for state, maps in (("own", merged.maps), ("merged", merged.graph.maps)):
        for robot, one in enumerate(maps):
            found = np.array(drawn["robots"][robot][state]).T * drawn["unit"]
            expected = lie.translation(lie.as_numpy(one.poses))
            np.testing.assert_allclose(found, expected, atol=0.5001 * drawn["unit"])
    extent = np.ptp(lie.translation(lie.as_numpy(merged.maps[0].poses)), axis=0).max()
    assert drawn["unit"] < 1e-3 * extent


def test_maps_in_space_are_seen_in_the_plane_of_their_extent(spatial):
    assert drawings(spatial, facts_of(spatial))["plane"] == "xy"
    assert 'value="xy" selected' in page(spatial, spatial.report())


def test_poses_are_thinned_to_the_last(merged, monkeypatch):
    monkeypatch.setattr(drawing, "MOST_POSES", 50)
    thin = drawings(merged, facts_of(merged))
    assert thin["every"] == 3
    for robot, one in enumerate(merged.maps):
        found = np.array(thin["robots"][robot]["own"]).T[-1] * thin["unit"]
        last = lie.translation(lie.as_numpy(one.poses))[-1]
        np.testing.assert_allclose(found, last, atol=thin["unit"])


def test_a_closure_claims_what_it_measures(merged, facts):
    """By jaxlie's own products, closure by closure."""
    closures, maps = merged.candidates, merged.graph.maps
    group = merged.graph.group
    for k in range(len(closures)):
        ends = [
            group(np.asarray(lie.parameters(maps[int(robot[k])].poses))[int(pose[k])])
            for robot, pose in (
                (closures.robot_a, closures.pose_a),
                (closures.robot_b, closures.pose_b),
            )
        ]
        claimed = ends[0] @ group(np.asarray(lie.parameters(closures.measurement))[k])
        error = ends[1].inverse() @ claimed
        np.testing.assert_allclose(facts.claimed[k], claimed.translation(), atol=1e-9)
        np.testing.assert_allclose(facts.away[k], np.linalg.norm(error.translation()), atol=1e-9)
        turned = np.linalg.norm(np.atleast_1d(error.rotation().log()))
        np.testing.assert_allclose(facts.turned[k], np.degrees(turned), atol=1e-6)


def test_accepted_closures_fit_and_random_ones_do_not(merged, facts):
    assert facts.away[merged.accepted].max() < 1.0
    assert np.median(facts.away[~merged.accepted]) > 3.0


def test_the_rivals_alignment_joins_its_closures(merged, drawn):
    (pair,), closures = drawn["pairs"], merged.candidates
    if not pair["rival"]:
        pytest.skip("no rival in this world")
    group = merged.graph.group
    alignment = group.from_matrix(np.array(pair["alignments"]["rival"]))
    for k in np.array(pair["closures"])[pair["rival"]]:
        ends = [
            group(np.asarray(lie.parameters(merged.maps[int(robot[k])].poses))[int(pose[k])])
            for robot, pose in (
                (closures.robot_a, closures.pose_a),
                (closures.robot_b, closures.pose_b),
            )
        ]
        placed = [
            end if int(r[k]) == 0 else alignment @ end
            for end, r in zip(ends, (closures.robot_a, closures.robot_b), strict=True)
        ]
        measured = group(np.asarray(lie.parameters(closures.measurement))[k])
        error = placed[1].inverse() @ (placed[0] @ measured)
        assert np.linalg.norm(error.translation()) < 1.0


def test_anchors_stand_in_the_groups_axes(merged, drawn):
    none, tied = drawn["anchors"]
    assert none is None
    space = drawn["space"]
    anchor = merged.graph.group(np.asarray(lie.parameters(lie.take(merged.anchors, 1))))
    turn = np.asarray(anchor.rotation().as_matrix())
    own = merged.anchor_covariance_at_middle[1][:space, :space]
    np.testing.assert_allclose(tied["covariance"], turn @ own @ turn.T, rtol=1e-9)
    middle = lie.translation(lie.as_numpy(merged.graph.maps[1].poses)).mean(axis=0)
    np.testing.assert_allclose(np.array(tied["middle"]) * drawn["unit"], middle, atol=drawn["unit"])


def test_without_evidence_nothing_is_made_up(given):
    facts = facts_of(given)
    assert drawings(given, facts)["pairs"] == []
    assert {FATES[fate] for fate in facts.fate} == {"accepted", "rejected"}


def test_maps_apart_have_no_residuals(refused):
    facts = facts_of(refused)
    assert np.isnan(facts.away).all()
    assert drawings(refused, facts)["anchors"] == [None, None]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (0.0, "0"),
        (0.98765, "0.988"),
        (-12.345, "−12.3"),
        (12345.6, "12,300"),
        (1e-9, "1.00 × 10⁻⁹"),
    ],
)
def test_numbers_are_for_people(value, text):
    assert number(value) == text


def test_words():
    assert counted(1, "closure") == "1 closure"
    assert counted(1200, "closure") == "1,200 closures"
    assert listed(["a", "b", "c"]) == "a, b and c"


def test_what_is_explained_besides_is_told():
    row = {
        "standing": "near miss",
        "worst_conflict": {
            "with": 4,
            "translation": 12.34,
            "translation_sigma": 0.5,
            "rotation": 45.6,
            "rotation_sigma": 1.0,
            "shares": {"a": 0.25, "b": 0.5, "closures": 0.25},
        },
        "enters_at": 0.9995,
        "fit": {"chi2": 31.25, "p": 1e-6, "residual": {"x": 3.0, "y": 2.0, "theta": 0.5}},
    }
    assert more(row) == [
        ["Standing", f"near miss: {STANDINGS['near miss']}"],
        ["Loop with 4", "misses by 12\u00a0m, 46° (standard deviations 0.5\u00a0m, 1°)"],
        ["Uncertainty from", "a 25 %, b 50 %, closures 25 %"],
        ["Let in by a gate of", "confidence 0.9995"],
        ["In the merged map", "χ² 31.2, 3 expected of a right one"],
    ]
    unknown = {"standing": "not weighed", "worst_conflict": None, "enters_at": None, "fit": None}
    assert more(unknown) == [["Standing", f"not weighed: {STANDINGS['not weighed']}"]]
    assert more(unknown | {"enters_at": 1.0})[1:] == [
        ["Let in by a gate of", "no use: it would let in nearly anything"]
    ]
