"""Plots: what is drawn and how it is labelled, not its pixels."""

import dataclasses
import subprocess
import sys
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from drawn import legend_of, line
from matplotlib import pyplot
from matplotlib.colors import to_hex

from pcm_jax import lie, plots
from pcm_jax.errors import InputError
from pcm_jax.plots import style as plot_style
from pcm_jax.simulation import simulate_city, simulate_sessions

mpl.use("Agg")


@pytest.fixture(scope="module")
def city():
    return simulate_city(seed=0, poses=300, inliers=6, aliased_size=3, random=11)


@pytest.fixture(scope="module")
def sessions():
    return simulate_sessions(seed=0, poses=200, inliers=5, random=5)


def segments(found):
    """Ends `[c, 2, 2]` of the closures in a line broken by NaN."""
    points = np.stack(found.get_data(), axis=-1).reshape(-1, 3, 2)
    assert np.isnan(points[:, 2]).all()
    return points[:, :2]


def test_trajectories_are_drawn_where_the_maps_are(city):
    ax = plots.plot_trajectories_with_closures(city.truth, names=["car", "bus"])
    for name, truth in zip(("car", "bus"), city.truth, strict=True):
        drawn = np.stack(line(ax, f"robot {name}").get_data(), axis=-1)
        assert np.array_equal(drawn, lie.parameters(truth)[:, 2:])
    assert ax.get_xlabel() == "x (m)"
    assert ax.get_ylabel() == "y (m)"
    assert ax.get_aspect() == 1.0
    assert legend_of(ax) == ["robot car", "robot bus"]


def test_robots_differ_in_more_than_colour():
    styles = [plot_style.robot_style(k, 8) for k in range(8)]
    assert len({(s["color"], s["linestyle"]) for s in styles}) == 8
    assert len({s["linewidth"] for s in styles}) == 8


def test_closures_join_their_poses(city):
    ax = plots.plot_trajectories_with_closures(city.graph.maps, city.graph.closures)
    ends = segments(line(ax, "candidates"))
    closures, maps = city.graph.closures, city.graph.maps
    for k in (0, 7, len(closures) - 1):
        for end, robot, pose in (
            (0, closures.robot_a, closures.pose_a),
            (1, closures.robot_b, closures.pose_b),
        ):
            place = np.asarray(maps[int(robot[k])].poses.unit_complex_xy)[int(pose[k]), 2:]
            assert np.array_equal(ends[k, end], place)


def test_known_truth_is_told_by_colour_dash_and_marker(city):
    accepted = city.is_true.copy()
    accepted[np.flatnonzero(city.is_true)[:2]] = False
    accepted[np.flatnonzero(~city.is_true)[:3]] = True
    ax = plots.plot_trajectories_with_closures(
        city.truth, city.graph.closures, accepted=accepted, is_true=city.is_true
    )
    assert set(legend_of(ax)) == {
        "robot a",
        "robot b",
        "accepted, true (4)",
        "accepted, false (3)",
        "rejected, true (2)",
        "rejected, false (14)",
    }
    kinds = [line(ax, label) for label in ("accepted, true", "accepted, false", "rejected, true")]
    kinds.append(line(ax, "rejected, false"))
    assert [len(segments(kind)) for kind in kinds] == [4, 3, 2, 14]
    for attribute in ("get_color", "get_marker"):
        assert len({getattr(kind, attribute)() for kind in kinds}) == 4
    assert kinds[3].get_linestyle() == ":"
    assert kinds[0].get_linewidth() == max(kind.get_linewidth() for kind in kinds)


def test_candidates_are_not_drawn_as_accepted_before_a_choice(city):
    drawn = {"maps": city.truth, "closures": city.graph.closures}
    plain = plots.plot_trajectories_with_closures(**drawn)
    assert legend_of(plain)[-1] == "candidates (23)"
    assert line(plain, "candidates").get_color() == plot_style.GREY
    labelled = plots.plot_trajectories_with_closures(**drawn, is_true=city.is_true)
    assert legend_of(labelled)[-2:] == ["false candidates (17)", "true candidates (6)"]
    for ax in (plain, labelled):
        assert not any("accepted" in text for text in legend_of(ax))
        assert plot_style.BLUE not in [drawn.get_color() for drawn in ax.get_lines()]


def test_thousands_of_closures_hide_neither_maps_nor_the_accepted(city):
    """As thin lines, the rejected ones faint and below the maps; their legend is seen."""
    many = np.arange(23).repeat(100)
    closures, true = city.graph.closures[many], city.is_true[many]
    few, ax = (
        plots.plot_trajectories_with_closures(city.truth, own, accepted=mask)
        for own, mask in ((city.graph.closures, city.is_true), (closures, true))
    )
    for kind in ("accepted", "rejected"):
        assert line(ax, kind).get_linewidth() < 0.4 * line(few, kind).get_linewidth()
    assert line(ax, "accepted").get_markersize() < 2.0
    assert line(ax, "accepted").get_alpha() == 1.0
    assert line(ax, "rejected").get_alpha() < 0.6
    robots = [line(ax, f"robot {name}").get_zorder() for name in "ab"]
    assert line(ax, "rejected").get_zorder() < min(robots)
    assert line(ax, "accepted").get_zorder() > max(robots)
    handles = ax.get_legend().legend_handles
    assert min(handle.get_linewidth() for handle in handles) >= 0.8
    assert {handle.get_alpha() for handle in handles} == {1.0}


def test_without_truth_closures_are_accepted_or_rejected(city):
    ax = plots.plot_trajectories_with_closures(
        city.truth, city.graph.closures, accepted=city.is_true
    )
    assert line(ax, "accepted").get_color() == plot_style.BLUE
    assert line(ax, "rejected").get_color() == plot_style.GREY
    assert legend_of(ax)[-2:] == ["rejected (17)", "accepted (6)"]


def test_maps_in_space_are_seen_from_above_unless_asked_otherwise(sessions):
    truth = lie.parameters(sessions.truth[0])
    above = plots.plot_trajectories_with_closures(sessions.truth)
    assert np.array_equal(line(above, "robot a").get_ydata(), truth[:, 5])
    assert above.get_title("right") == "plane x–y, seen along z"
    side = plots.plot_trajectories_with_closures(sessions.truth, projection="xz")
    assert np.array_equal(line(side, "robot a").get_ydata(), truth[:, 6])
    assert side.get_ylabel() == "z (m)"
    assert side.get_title("right") == "plane x–z, seen along y"


def test_maps_whose_y_points_down_are_seen_from_above(sessions):
    """A camera's: z ahead, y down. The plane is that of the two greatest extents."""
    turned = lie.exp(lie.group_of(sessions.truth[0]), np.array([0, 0, 0, np.pi / 2, 0, 0]))
    maps = [lie.compose(turned, truth) for truth in sessions.truth]
    ax = plots.plot_trajectories_with_closures(maps)
    assert ax.get_ylabel() == "z (m)"
    assert np.allclose(line(ax, "robot a").get_ydata(), lie.parameters(maps[0])[:, 6])
    axes = plots.plot_comparison({"truth": (maps, None), "again": (maps, None)}, None)
    assert [ax.get_xlabel() for ax in axes] == ["x (m)"] * 2
    assert axes[0].get_ylabel() == "z (m)"
    assert np.ptp(axes[0].get_ylim()) > np.ptp(lie.parameters(maps[0])[:, 6])


def test_a_merge_in_space_offers_other_planes(sessions):
    result = SimpleNamespace(
        graph=sessions.graph, candidates=sessions.graph.closures, accepted=sessions.is_true
    )
    ax = plots.plot_merge(result, projection="yz")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("y (m)", "z (m)")
    assert "closures accepted" in ax.get_title("left")
    with pytest.raises(InputError, match="projection"):
        plots.plot_merge(result, projection="xw")


def test_a_plane_has_no_third_axis(city):
    with pytest.raises(InputError, match="projection"):
        plots.plot_trajectories_with_closures(city.truth, projection="xz")


@pytest.mark.parametrize("mask", ["accepted", "is_true"])
def test_masks_of_another_length_are_refused(city, mask):
    with pytest.raises(InputError, match=mask):
        plots.plot_trajectories_with_closures(
            city.truth, city.graph.closures, **{mask: np.ones(3, bool)}
        )


def test_a_merge_says_how_much_it_accepted(city):
    result = SimpleNamespace(
        graph=city.graph, candidates=city.graph.closures, accepted=city.is_true
    )
    ax = pyplot.figure().subplots()
    assert plots.plot_merge(result, ax) is ax
    assert ax.get_title() == "6 of 23 closures accepted"
    assert "accepted, true (6)" in legend_of(plots.plot_merge(result, is_true=city.is_true))


def apart(count):
    """A merge of a + b, the others by themselves, with a candidate between b and the third."""
    maps = [simulate_city(seed=seed, poses=40).graph.maps[0] for seed in range(count)]
    maps = [dataclasses.replace(own, name="abcdefghijklmnopq"[k]) for k, own in enumerate(maps)]
    closures = SimpleNamespace(
        robot_a=np.array([0, 1]),
        pose_a=np.array([3, 5]),
        robot_b=np.array([1, 2]),
        pose_b=np.array([4, 6]),
    )
    return SimpleNamespace(
        graph=SimpleNamespace(maps=maps),
        candidates=closures,
        accepted=np.array([True, False]),
        groups=((0, 1), *((k,) for k in range(2, count))),
    )


def test_groups_that_nothing_connects_have_panels_of_their_own():
    """They share no frame; the candidate between them has no place in either."""
    ax = plots.plot_merge(apart(3))
    panels = ax.figure.axes
    assert [panel.get_title() for panel in panels] == ["a + b", "c"]
    assert ax is panels[0]
    assert legend_of(panels[0]) == ["robot a", "robot b", "accepted (1)"]
    assert legend_of(panels[1]) == ["robot c"]
    colors = [line(panel, "robot").get_color() for panel in (panels[1],)]
    assert colors == [plot_style.robot_style(2, 3)["color"]]  # its own, in every panel
    assert "2 groups, each in a frame of its own" in ax.figure.get_suptitle()
    assert "1 of 2 closures accepted" in ax.figure.get_suptitle()


def test_axes_that_are_given_show_the_largest_group():
    _, ax = pyplot.subplots()
    assert plots.plot_merge(apart(3), ax) is ax
    assert legend_of(ax) == ["robot a", "robot b", "accepted (1)"]
    assert "1 groups more" in ax.get_title()


def test_more_groups_than_panels_are_counted():
    ax = plots.plot_merge(apart(15))
    assert len(ax.figure.axes) == 12
    assert "2 groups more" in ax.figure.get_suptitle()


def test_a_comparison_lays_all_maps_over_the_first_at_one_scale(city):
    motion = lie.exp(lie.group_of(city.truth[0]), np.array([30.0, -80.0, 2.0]))
    moved = [lie.compose(motion, truth) for truth in city.truth]
    every = np.ones_like(city.is_true)
    panels = {"truth": (city.truth, None), "all": (moved, every), "PCM": (moved, city.is_true)}
    axes = plots.plot_comparison(panels, city.graph.closures, is_true=city.is_true)
    assert [ax.get_title() for ax in axes] == list(panels)
    for ax in axes[1:]:
        assert ax.get_xlim() == axes[0].get_xlim()
        assert ax.get_ylim() == axes[0].get_ylim()
        drawn, true = (line(x, "robot b").get_xydata() for x in (ax, axes[0]))
        assert np.allclose(drawn, true, atol=1e-6)
    assert len(axes[0].get_lines()) == 2
    assert "false closures accepted: 17 of 17" in axes[1].get_xlabel()
    assert "true closures accepted: 6 of 6" in axes[2].get_xlabel()
    assert "false closures accepted: 0 of 17" in axes[2].get_xlabel()
    assert legend_of(axes[0].figure) == [
        "robot a",
        "robot b",
        "accepted, false",
        "accepted, true",
        "rejected, false",
    ]


def test_a_comparison_fits_its_figure(city):
    panels = {"truth": (city.truth, None), "PCM": (city.truth, city.is_true)}
    figure = plots.plot_comparison(panels, city.graph.closures)[0].figure
    figure.canvas.draw()
    width, height = figure.canvas.get_width_height()
    for ax in figure.axes:
        box = ax.get_tightbbox()
        assert box.x0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
        assert box.y0 >= figure.legends[0].get_tightbbox().y1 - 1


def test_a_comparison_can_be_drawn_into_given_axes(city):
    axes = pyplot.figure().subplots(1, 2)
    panels = {"truth": (city.truth, None), "PCM": (city.truth, city.is_true)}
    drawn = plots.plot_comparison(panels, city.graph.closures, axes=axes)
    assert drawn == list(axes)
    axes[0].figure.canvas.draw()


def test_squared_distances_break_their_colours_at_the_gate():
    squared = np.array([[0.0, 2.0, 9.0], [2.0, 0.0, 11.0], [0.0, 1e9, 0.0]])
    ax = plots.plot_squared_distances(squared, 10.0)
    image = ax.images[0]
    colors = image.cmap(image.norm(image.get_array()))
    brightness = colors[..., :3].mean(axis=-1)
    inside = squared <= 10.0
    off_diagonal = ~np.eye(3, dtype=bool)
    gap = brightness[~inside].min() - brightness[inside & off_diagonal].max()
    assert gap > 0.2  # also in grey
    assert np.ma.getmaskarray(image.get_array()).tolist() == np.eye(3, dtype=bool).tolist()
    assert ax.get_xlabel() == "measurement v"
    bar = ax.figure.axes[1]
    assert "gate γ² = 10" in bar.get_ylabel()
    assert bar.lines[-1].get_ydata()[0] == 10.0


def test_squared_distances_can_be_reordered():
    squared = np.arange(1.0, 10.0).reshape(3, 3)
    ax = plots.plot_squared_distances(squared, 5.0, order=np.array([2, 0, 1]))
    shown = ax.images[0].get_array()
    assert shown[0, 1] == squared[2, 0]
    assert shown[1, 2] == squared[0, 1]
    assert "reordered" in ax.get_ylabel()


@pytest.mark.parametrize(("squared", "gate"), [(np.ones((2, 3)), 1.0), (np.ones((2, 2)), 0.0)])
def test_squared_distances_refuse_what_has_no_meaning(squared, gate):
    with pytest.raises(InputError):
        plots.plot_squared_distances(squared, gate)


def test_a_clique_lights_up_in_the_consistency_graph():
    graph = np.zeros((7, 7), bool)
    graph[np.ix_(range(4), range(4))] = True
    graph[5, 6] = graph[6, 5] = True
    np.fill_diagonal(graph, False)
    members = np.arange(7) < 4
    ax = plots.plot_consistency_graph(graph, members)
    chords = [c for c in ax.collections if hasattr(c, "get_segments")]
    assert {to_hex(c.get_colors()[0]).upper(): len(c.get_segments()) for c in chords} == {
        plot_style.GREY: 1,
        plot_style.BLUE: 6,
    }
    assert legend_of(ax) == ["in the clique (4)", "other (3)"]
    assert sorted(text.get_text() for text in ax.texts) == list("0123456")


def test_the_consistency_graph_shows_mistakes_where_truth_is_known():
    graph = ~np.eye(6, dtype=bool)
    members, inliers = np.array([1, 1, 1, 0, 0, 0], bool), np.array([1, 1, 0, 1, 0, 0], bool)
    ax = plots.plot_consistency_graph(graph, members, is_true=inliers)
    assert legend_of(ax) == [
        "in the clique, true (2)",
        "in the clique, false (1)",
        "other, true (1)",
        "other, false (2)",
    ]


def test_large_and_empty_graphs_are_drawn_without_numbers():
    for count in (0, 200):
        ax = plots.plot_consistency_graph(np.zeros((count, count), bool))
        assert not ax.texts


def test_of_many_thousands_of_pairs_some_are_drawn():
    graph = ~np.eye(200, dtype=bool)
    ax = plots.plot_consistency_graph(graph, np.arange(200) < 20)
    chords = [c for c in ax.collections if hasattr(c, "get_segments")]
    drawn = {to_hex(c.get_colors()[0])[:7].upper(): len(c.get_segments()) for c in chords}
    assert drawn == {plot_style.GREY: 1408, plot_style.BLUE: 190}  # every 14th of 19,710
    assert "agree (one in 14 of 19,710 drawn)" in legend_of(ax)


@pytest.mark.parametrize(("count", "shape"), [(3, (1, 3)), (4, (2, 2)), (5, (3, 2))])
def test_four_or_five_panels_stand_two_abreast(city, count, shape):
    """A phone shows no more; they name the axis at the left of each row."""
    panels = {str(k): (city.truth, None) for k in range(count)}
    axes = plots.plot_comparison(panels, city.graph.closures)
    grid = axes[0].get_gridspec()
    assert (grid.nrows, grid.ncols) == shape
    assert [bool(ax.get_ylabel()) for ax in axes] == [k % shape[1] == 0 for k in range(count)]


@pytest.mark.parametrize("wrong", [{"members": np.ones(2, bool)}, {"is_true": np.ones(4, bool)}])
def test_a_graph_refuses_masks_of_another_length(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        plots.plot_consistency_graph(np.zeros((3, 3), bool), **wrong)


@pytest.mark.slow
def test_matplotlib_is_not_loaded_until_something_is_drawn():
    code = (
        "import sys, pcm_jax.evaluation, pcm_jax.plots, pcm_jax.simulation;"
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
