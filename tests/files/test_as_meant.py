"""Files that public threads stumbled over: each is read as meant, or its line says what to do.

Every test stands for a kind of file; the small files are written here.
"""

from itertools import pairwise

import numpy as np
import pytest

from pcm_jax import lie, merge
from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files import read_candidates, read_graph
from pcm_jax.files.pose_file import Reading
from pcm_jax.files.read import read_with_account

FLAT = "2500 0 0 2500 0 10000"
SOLID = "2500 0 0 0 0 0 2500 0 0 0 0 2500 0 0 0 10000 0 0 10000 0 10000"


def key(name: str) -> int:
    return (ord(name[0]) << 56) | int(name[1:])


def labelled(letter: str, name: str) -> int:
    top = ord(letter) << 56 if letter else 0
    return top | (ord(name[0]) << 48) | int(name[1:])


def flat(a, b, x, y=0.0, theta=0.0, information=FLAT):
    return f"EDGE_SE2 {a} {b} {x!r} {y!r} {theta!r} {information}"


def solid(a, b, x, y=0, information=SOLID):
    return f"EDGE_SE3:QUAT {a} {b} {x} {y} 0 0 0 0 1 {information}".rstrip()


def chain(ids, edge=solid, **options):
    return [edge(a, b, 1, **options) for a, b in pairwise(ids)]


def vertices(ids):
    return [f"VERTEX_SE3:QUAT {one} {k} 0 0 0 0 0 1" for k, one in enumerate(ids)]


@pytest.fixture
def account(write):
    """Reads files of lines with an account; names are a, b, … unless they are given."""

    def read(*files, closures=None, names="abcdef", reading=None, **options):
        paths = [
            write(*lines, name=f"{name}.g2o") for name, lines in zip(names, files, strict=False)
        ]
        extra = None if closures is None else write(*closures, name="closures.csv")
        return read_with_account(paths, extra, reading or Reading(), **options)

    return read


# One closure counted as several.


def test_a_closure_said_from_both_ends(account):
    """By robot a as a1 → b0, by robot b as its inverse, with information as each wrote it."""
    a = [*chain([key("a0"), key("a1")], flat), flat(key("a1"), key("b0"), 5.0, 3.0)]
    b = [*chain([key("b0"), key("b1")], flat), flat(key("b0"), key("a1"), -5.0, -3.0)]
    graph, told = account(a, b)
    assert len(graph.closures) == 1
    (copy,) = told.copies
    assert (copy.again[-6:], copy.first[-6:]) == (".g2o:2", ".g2o:2") and copy.turned
    assert any("counted once" in line for line in told.warnings())
    assert not merge(graph, minimum_inliers=2).accepted.any()


def test_a_closure_said_twice_in_a_file_and_again_in_the_csv(account):
    line = flat(key("a1"), key("b0"), 5.0, 3.0)
    maps = [*chain([key("a0"), key("a1")], flat), *chain([key("b0"), key("b1")], flat), line, line]
    csv = [f"a,1,b,0,5,3,0,{FLAT.replace(' ', ',')}", f"b,0,a,1,-5,-3,0,{FLAT.replace(' ', ',')}"]
    graph, told = account(maps, closures=csv)
    assert len(graph.closures) == 1
    assert [copy.again.rsplit(":")[-1] for copy in told.copies] == ["4", "1", "2"]


def test_two_measurements_of_one_pair_stay_two(account):
    maps = [*chain([key("a0"), key("a1")], flat), *chain([key("b0"), key("b1")], flat)]
    maps += [flat(key("a1"), key("b0"), 5.0), flat(key("a1"), key("b0"), 5.001)]
    graph, told = account(maps)
    assert len(graph.closures) == 2 and not told.copies


# Covariances where information belongs.


def covariances(information="0.0004 0 0 0.0004 0 0.0001"):
    """Three closures agree, the fourth is 9 m and 2 rad off."""
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    a, b = ([key(f"{letter}{k}") for k in range(4)] for letter in "ab")
    lines = [*chain(a, flat, information=information), *chain(b, flat, information=information)]
    for k in range(3):
        x, y = np.array([2.0, 1.0]) - [k, 0] + turn @ [k, 0]
        lines.append(flat(a[k], b[k], float(x), float(y), 0.5, information))
    return [*lines, flat(a[3], b[0], -7.0, 4.0, 2.5, information)]


def test_covariances_are_told(account):
    _, told = account(covariances())
    assert [severe for _, severe in told.doubts] == [True, True, True]
    line = told.doubts[0][0]
    assert "sigmas of 50 m and 100 rad for a step of 1 m cannot be meant" in line
    assert "read as covariances they are 0.02 m and 0.01 rad (--information covariance)" in line
    assert "sqrt" not in line  # would widen them to 2500 m


def test_covariances_are_read(account):
    graph, told = account(covariances(), reading=Reading(information="covariance"))
    assert not told.doubts
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([2500, 2500, 1e4]))
    assert merge(graph, minimum_inliers=2).accepted.tolist() == [True, True, True, False]


def test_information_read_as_covariances_is_told(account):
    _, told = account(covariances(FLAT), reading=Reading(information="covariance"))
    assert "(--information as-written)" in told.doubts[0][0]


def lines_of(letter, information=FLAT, step=1.0):
    ids = [key(f"{letter}{k}") for k in range(4)]
    return [flat(a, b, step, information=information) for a, b in pairwise(ids)]


def test_a_reading_that_spoils_another_robots_file_is_not_proposed(account):
    """All files are read alike: --information covariance would mend b's and spoil a's."""
    told = account(lines_of("a"), lines_of("b", "0.0004 0 0 0.0004 0 0.0001"))[1]
    line = next(line for line in told.warnings() if "robot b" in line)
    assert "read as covariances they are 0.02 m and 0.01 rad, but so robot a's cannot" in line
    assert "--information" not in line


def test_covariances_of_closures_alone(account):
    row = "a,0,b,1,1,0,0,0.0004,0,0,0.0004,0,0.0001"
    told = account(lines_of("a"), lines_of("b"), closures=[row])[1]
    line = next(line for line in told.warnings() if line.startswith("closures"))
    assert "a CSV may call its columns cov_11" in line and "--information" not in line


def test_units(account):
    """One robot's file is in millimetres, or the closures are."""
    told = account(lines_of("a"), lines_of("b", step=1000.0))[1]
    assert any("robot b: its steps of 1e+03 m are 1e+03 times" in line for line in told.warnings())
    row = f"a,0,b,1,1500,200,0,{FLAT.replace(' ', ',')}"
    told = account(lines_of("a"), lines_of("b"), closures=[row])[1]
    assert any("maps of 3 m cannot be meant; are they in" in line for line in told.warnings())


def test_quaternions_that_begin_with_w(account):
    """Steps that hardly turn become half turns about x."""
    lines = [f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0.9999 0 0 0.0141 {SOLID}" for k in range(3)]
    told = account(chain(range(4)), lines)[1]
    assert any("robot b: its steps turn by 3.11 rad; is" in line for line in told.warnings())


def test_honest_information_is_not_doubted(account):
    _, told = account(covariances(FLAT))
    assert not told.doubts


# Whose ids.


def test_two_robots_of_one_letter(account):
    one = chain([key(f"x{k}") for k in range(3)])
    two = [line.replace(" 1 0 0 0 0 0 1 ", " 0 1 0 0 0 0 1 ") for line in one]
    graph, told = account(one, two)
    assert graph.names == ("a", "b")
    assert "x is measured differently in " in told.files[0].ids
    places = [lie.translation(lie.as_numpy(m.poses))[-1].tolist() for m in graph.maps]
    assert places == [[2, 0, 0], [0, 2, 0]]


def test_two_robots_of_one_letter_that_meet_a_third(account):
    one = chain([key(f"x{k}") for k in range(3)])
    two = [line.replace(" 1 0 0 0 0 0 1 ", " 0 1 0 0 0 0 1 ") for line in one]
    third = [*chain([key(f"y{k}") for k in range(3)]), solid(key("x0"), key("y0"), 1)]
    with pytest.raises(FileFormatError, match=r"b.g2o:1: .* letter x differently than .*a.g2o:1"):
        account([*one, *third], two)


@pytest.mark.parametrize("letter", ["g", ""])
def test_labelled_symbols(account, letter):
    a, b = ([labelled(letter, f"{label}{k}") for k in range(3)] for label in "AB")
    lines = [*vertices(a), *vertices(b), *chain(a), *chain(b)]
    graph, told = account([*lines, solid(a[0], b[0], 0, 2), solid(a[2], b[2], 0, 2)])
    assert graph.names == ("A", "B")
    assert graph.maps[1].pose_name(2) == "B2"
    assert len(graph.closures) == 2
    assert "labelled symbols" in told.files[0].ids


PLAIN = (chain([0, 1, 2]), chain([100, 101, 102]))
BETWEEN = {
    "apart": [solid(0, 100, 0, 2), solid(2, 102, 0, 2)],
    "joined": [solid(0, 100, 0, 2), solid(0, 101, 1, 2)],
}


@pytest.mark.parametrize("lines", BETWEEN.values(), ids=BETWEEN)
@pytest.mark.parametrize("how", ["file", "closures", "own"])
def test_plain_ids_unique_over_the_files(account, lines, how):
    first, second = PLAIN
    if how == "file":
        graph, told = account(first, second, lines)
        assert "it defines no robot" in told.files[2].ids
    elif how == "closures":
        graph, told = account(first, second, closures=lines)
    else:
        graph, told = account(
            [*vertices([0, 1, 2]), *first, *lines], [*vertices([100, 101, 102]), *second]
        )
    assert graph.names == ("a", "b")
    assert "shared by the files" in told.files[0].ids
    assert (graph.closures.robot_a.tolist(), graph.closures.robot_b.tolist()) == ([0, 0], [1, 1])
    assert graph.closures.pose_a.tolist()[0] == 0


@pytest.mark.parametrize(
    "robots",
    [
        (range(7, 43, 3), range(12)),  # keyframes of one, every pose of the other
        (range(0, 50, 10), range(30)),
        (range(-6, 20, 2), range(-9, 30, 3), range(8)),
    ],
)
def test_ids_with_gaps_that_are_each_files_own(account, robots):
    """No edge leads out of a file, though ids of one lie between those of another."""
    graph, _ = account(*(chain(ids, flat) for ids in robots))
    assert [one.ids.tolist() for one in graph.maps] == [list(ids) for ids in robots]
    assert not len(graph.closures)


def test_candidates_inside_a_robot_join_its_map(account):
    graph, _ = account(*PLAIN, [solid(0, 2, 2), solid(0, 100, 0, 2)])
    assert [one.num_edges for one in graph.maps] == [3, 2]
    assert len(graph.closures) == 1


def test_another_robots_poses_repeated(account):
    """cg_mrslam: ids of 10000 a robot; a file repeats the other's poses that it has seen."""
    one, two = list(range(10000, 10006)), list(range(20000, 20006))
    first = [*vertices(one), "VERTEX_SE3:QUAT 20003 9 9 0 0 0 0 1", *chain(one)]
    first.append(solid(10005, 20003, 1))
    graph, told = account(first, [*vertices(two), *chain(two)])
    assert [m.num_poses for m in graph.maps] == [6, 6]
    assert lie.translation(lie.as_numpy(graph.maps[1].poses))[3].tolist() == [3, 0, 0]
    assert any("1 vertices are other files' poses" in note for note in told.files[0].notes)


def test_plain_ids_that_may_be_two_robots(account):
    with pytest.raises(FileFormatError, match=r"c.g2o:1: edge between poses 0 and 2, but .*a.g2o"):
        account(chain([0, 1, 2]), chain([0, 1, 2]), [solid(0, 2, 0, 2)])


def test_ids_on_request(account):
    first, second = PLAIN
    graph, _ = account(first, second, reading=Reading(ids="shared"))
    assert graph.names == ("a", "b")
    with pytest.raises(InputError, match=r"ids: 'shared' given, but .* both have a pose"):
        account(first, first, reading=Reading(ids="shared"))
    with pytest.raises(FileFormatError, match=r"a.g2o:1: id 0 is no GTSAM symbol.*stripped"):
        account(first, reading=Reading(ids="symbols"))
    keyed = chain([key("a0"), key("a1")])
    graph, _ = account(keyed, names=["run"], reading=Reading(ids="per-file"))
    assert graph.names == ("run",)


def test_landmarks_with_an_attitude(account):
    x, seen = [key("x0"), key("x1")], [key("l0"), key("l1")]
    lines = [*vertices(x), *chain(x), *vertices(seen)]
    graph, told = account([*lines, *(solid(a, b, 0, 2) for a, b in zip(x, seen, strict=True))])
    assert graph.names == ("x",)
    assert told.notes[0].startswith(
        "no edge joins l0, l1 among themselves: landmarks, no trajectory"
    )


def test_poses_are_called_by_symbols_in_messages(account):
    lines = [*vertices([key("l0"), key("l1")])]
    with pytest.raises(FileFormatError, match="no edges lead from pose l0 to pose l1"):
        account(lines)


# Numbers.


def test_other_columns_in_a_quaternions_place(account):
    with pytest.raises(FileFormatError, match=r"csv:1: quaternion of norm 5.09902 is no rounding"):
        account(*PLAIN, closures=["a,0,b,100,0,0,0,1,4,3,0"])


def test_decimal_commas(account):
    with pytest.raises(FileFormatError, match=r"'0,5' given, .* not a decimal comma"):
        account(["VERTEX_SE2 1 0,5 0 0"])


def test_edges_without_information(account):
    lines = [*vertices([0, 1]), solid(0, 1, 1, information="")]
    with pytest.raises(FileFormatError, match=r"g2o:3: 10 columns, .*--default-sigmas M RAD"):
        account(lines)
    graph, _ = account(lines, reading=Reading(default_sigmas=(0.1, 0.01)))
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([100] * 3 + [1e4] * 3))
    toro = ["VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0", "EDGE2 0 1 1 0 0"]
    graph, _ = account(toro, reading=Reading(default_sigmas=(0.1, 0.01)))
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([100, 100, 1e4]))


@pytest.mark.parametrize("sigmas", [(0.1,), (0.1, 0), (0.1, -1), "ab", (0.1, float("nan"))])
def test_bad_default_sigmas(sigmas):
    with pytest.raises(InputError, match="default_sigmas: "):
        Reading(default_sigmas=sigmas)


def test_tags_of_other_programs(account):
    rtabmap = [*vertices([5, 1, 2]), *chain([1, 2]), solid(1, 5, 0, 2).replace(":QUAT", "")]
    graph, _ = account(rtabmap)
    assert (graph.maps[0].num_poses, graph.maps[0].num_edges) == (3, 2)
    vertigo = [*(f"VERTEX_SE2 {k} {k} 0 0" for k in (1, 2, 3)), *chain([1, 2, 3], flat)]
    vertigo += ["VERTEX_SWITCH 4 1", f"EDGE_SE2_SWITCHABLE 3 1 4 -2 0 0 {FLAT}"]
    graph, told = account([*vertigo, f"EDGE_SE2_MAXMIX 3 2 0.01 -1 0 0 {FLAT}"])
    one = graph.maps[0]
    assert (one.tail.tolist(), one.head.tolist()) == ([0, 1, 2, 2], [1, 2, 0, 1])
    np.testing.assert_allclose(lie.translation(one.measurement)[2:, 0], [-2, -1])
    solid_ones = [*chain([1, 2, 3]), "EDGE_SE3_CALIB 1 2 0 0 0 0 0 0 1"]
    for tag in ("SE3_SWITCHABLE", "SE3:QUAT_SWITCHABLE", "SE3_MAXMIX", "SE3:QUAT_MAXMIX"):
        loop = f"EDGE_{tag} 3 1 4 -2 0 0 0 0 0 1 {SOLID}"
        one = account([*solid_ones, loop])[0].maps[0]
        assert (one.tail.tolist(), one.head.tolist()) == ([0, 1, 2], [1, 2, 0])
        np.testing.assert_allclose(lie.translation(one.measurement)[2], [-2, 0, 0])
    assert told.files[0].left_out == {"VERTEX_SWITCH": 1}


def test_priors(account):
    """A pose, a position turned into the pose's frame, and a pose seen through an offset."""
    turned = "VERTEX_SE2 1 1 0 1.5707963267948966"
    lines = ["VERTEX_SE2 0 0 0 0", turned, *chain([0, 1], flat)]
    lines += [f"EDGE_PRIOR_SE2 0 1 2 0 {FLAT}", "EDGE_PRIOR_SE2_XY 1 5 6 4 0 9"]
    graph, _ = account(lines)
    priors = graph.maps[0].priors
    assert priors.pose.tolist() == [0, 1]
    np.testing.assert_allclose(lie.translation(priors.measurement), [[1, 2], [5, 6]])
    np.testing.assert_allclose(priors.information[1], np.diag([9, 4, 0]), atol=1e-12)
    graph, _ = account(lines, ignore_priors=True)
    assert graph.maps[0].priors is None
    offset = "PARAMS_SE3OFFSET 7 1 0 0 0 0 0 1"
    prior = f"EDGE_SE3_PRIOR 0 7 3 0 0 0 0 0 1 {SOLID}"
    graph, _ = account([offset, *vertices([0, 1]), *chain([0, 1]), prior])
    np.testing.assert_allclose(lie.translation(graph.maps[0].priors.measurement), [[2, 0, 0]])
    weight = np.asarray(graph.maps[0].priors.information[0])
    assert weight[5, 5] == pytest.approx(10000 + 2500) and weight[1, 5] == pytest.approx(2500)


# Names and candidates.


def test_names_come_from_files(account, write):
    """Whatever their order; the CSV's names are the files'."""
    b, a = (chain([0, 1, 2]), chain([0, 1, 2]))
    csv = [f"a,0,b,2,0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"]
    graph, _ = account(b, a, names="ba", closures=csv)
    assert graph.names == ("b", "a")
    assert (graph.closures.robot_a.tolist(), graph.closures.robot_b.tolist()) == ([1], [0])
    with pytest.raises(FileFormatError, match="there is no robot 'a', expected one of b, c"):
        account(b, a, names="bc", closures=csv)


@pytest.mark.parametrize(
    ("names", "called", "robots"),
    [
        (("left", "right"), "0,1", [0, 1]),
        (("robot1", "robot2"), "1,2", [0, 1]),
        (("robot1", "robot2"), "0,1", [0, 1]),
        (("left", "right"), "a,b", [0, 1]),
        (("left", "right"), "right,left", [1, 0]),
        (("left", "right"), "right.g2o,left.g2o", [1, 0]),
    ],
)
def test_robots_by_name_number_or_letter(account, names, called, robots):
    one, two = called.split(",")
    csv = [f"{one},0,{two},2,0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"]
    graph, _ = account(*PLAIN[:1] * 2, names=names, closures=csv)
    assert [graph.closures.robot_a[0], graph.closures.robot_b[0]] == robots


def test_robots_by_their_place_are_told(account):
    maps = [chain(range(2), flat)] * 2
    _, told = account(*maps, closures=["0,0,1,1,1,0,0"], names=("north", "south"))
    assert told.files[2].ids == "robots by name, candidates only (0 is north, 1 is south)"
    _, told = account(*maps, closures=["south,0,north,1,1,0,0"], names=("north", "south"))
    assert told.files[2].ids == "robots by name, candidates only"


@pytest.mark.parametrize(
    ("names", "called"), [(("beta", "alpha"), "a"), (("alpha", "delta", "bravo"), "b")]
)
def test_letters_that_are_other_robots_initials(account, names, called):
    """In the order of the files a is beta, but who says a means alpha."""
    maps = [chain(range(2), flat)] * len(names)
    row = f"{called},0,{names[-1] if called == 'a' else names[0]},1,1,0,0"
    with pytest.raises(FileFormatError, match=rf"robot '{called}' may mean \w+ or \w+, expected"):
        account(*maps, closures=[row], names=names)


def test_ambiguous_numbers(account):
    csv = [f"1,0,robot3,2,0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"]
    with pytest.raises(FileFormatError, match="robot '1' may mean robot1 or robot2"):
        account(*PLAIN[:1] * 3, names=("robot1", "robot2", "robot3"), closures=csv)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_names_of_columns_decide(account, mark):
    names = mark.join(["id_b", "id_a", "qw", "tx", "ty", "tz", "qx", "qy", "qz", "inliers", "note"])
    row = mark.join(["b2", "a0", "1", "5", "6", "7", "0", "0", "0", "12", "hello"])
    graph, told = account(*PLAIN[:1] * 2, closures=[names, row])
    np.testing.assert_allclose(lie.translation(graph.closures.measurement), [[5, 6, 7]])
    assert graph.closures.weight.tolist() == [12.0]
    assert (graph.closures.pose_a.tolist(), graph.closures.pose_b.tolist()) == ([0], [2])
    assert any("note" in note for file in told.files for note in file.notes)


def test_degrees(account):
    lines = chain([0, 1, 2], flat)
    _, told = account(lines, lines, closures=["a,0,b,1,1,2,90,0.1,0.1,0.1"])
    assert any("theta 90 is more than a turn" in line for line in told.warnings())


def test_a_file_given_twice(write):
    path = write(*chain([0, 1]))
    with pytest.raises(InputError, match=rf"{path}: given twice"):
        read_graph(path, path)


def test_lists_of_files_and_other_things(write):
    paths = [write(*lines, name=f"{name}.g2o") for name, lines in zip("ab", PLAIN, strict=True)]
    assert read_graph(paths).names == ("a", "b")
    with pytest.raises(InputError, match="paths: int given, expected a path"):
        read_graph(3)  # type: ignore[arg-type]
    gtsam = pytest.importorskip("gtsam")
    with pytest.raises(InputError, match="from_gtsam"):
        read_graph(gtsam.NonlinearFactorGraph())


def test_candidates_alone(write):
    path = write("robot_a,id_a,robot_b,id_b,x,y,theta", "a,0,b,1,1,2,3", name="c.csv")
    with pytest.raises(FileFormatError, match=r"c.csv: candidates only, expected a map as well"):
        read_graph(path)


# Bad candidates.


def test_a_candidate_from_a_pose_to_itself(account):
    rest = f"0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"
    graph, told = account(*PLAIN[:1] * 2, closures=[f"a,0,b,1,{rest}", f"a,1,a,1,{rest}"])
    assert len(graph.closures) == 1
    assert "1 candidates from a pose to itself left out" in told.notes[0]


def test_a_candidate_from_a_pose_to_itself_in_a_graph_file(write):
    """Left out of candidates; of a map it is an error that calls the pose by its name."""
    maps = [write(flat(key(f"{x}0"), key(f"{x}1"), 1), name=f"{x}.g2o") for x in "ab"]
    lines = [flat(key("a1"), key("a1"), 0), flat(key("a1"), key("b1"), 2)]
    with pytest.warns(InputWarning, match=r"c.g2o: 1 candidates from a pose to itself left out"):
        graph = read_graph(*maps, closures=write(*lines, name="c.g2o"))
    assert len(graph.closures) == 1
    with pytest.raises(FileFormatError, match=r"c.g2o:1: edge from pose a1 to itself"):
        read_graph(*maps, write(*lines, name="c.g2o"))
    with pytest.warns(InputWarning, match=r"1 candidates from a pose to itself left out"):
        assert len(read_candidates(write(*lines, name="c.g2o"), graph)) == 1


def test_bad_candidates_on_request(account):
    rest = f"0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"
    rows = [f"a,0,b,1,{rest}", f"a,x,b,1,{rest}", f"a,0,z,1,{rest}", f"a,0,b,77,{rest}"]
    with pytest.raises(FileFormatError, match=r"csv:2: 'x' given"):
        account(*PLAIN[:1] * 2, closures=rows)
    graph, told = account(*PLAIN[:1] * 2, closures=rows, skip_bad=True)
    assert len(graph.closures) == 1
    counts = [note.split(": ")[1].split()[0] for note in told.notes]
    assert counts == ["1", "2"]  # those that cannot be read, those that name no pose


def test_maps_stay_strict(account):
    with pytest.raises(FileFormatError, match="g2o:3: edge from pose 1 to itself"):
        account([*chain([0, 1, 2]), solid(1, 1, 1)], skip_bad=True)


def test_sessions_of_one_file(account):
    lines = [*chain([1, 2, 3]), *chain([4, 5, 6])]
    with pytest.raises(FileFormatError, match="the map falls into 2 parts"):
        account(lines)
    graph, _ = account(lines, reading=Reading(components=True))
    assert graph.names == ("a-1", "a-2")
    graph, _ = account([*lines, solid(1, 4, 0, 2)], reading=Reading(components=True))
    assert [m.ids.tolist() for m in graph.maps] == [[1, 2, 3], [4, 5, 6]]
    assert len(graph.closures) == 1


def test_warnings_are_inputs(write):
    path = write(*covariances())
    with pytest.warns(InputWarning) as caught:
        read_graph(path)
    assert len(caught) == 3


def test_information_that_lacks_directions(account):
    """A planar closure in space: said so, with what can be done."""
    planar = "2500 0 0 0 0 0 2500 0 0 0 0 0 0 0 0 0 0 0 0 0 10000"
    lines = [*chain([0, 1, 2]), solid(0, 2, 2, information=planar)]
    with pytest.raises(FileFormatError, match=r"g2o:3: .*rank 3 of 6: planar or 4-DoF.*--repair"):
        account(lines)
    graph, told = account(lines, reading=Reading(repair="clip"))
    assert told.clipped == 1 and graph.maps[0].num_edges == 3


def test_candidates_between_maps_in_memory(write, account):
    graph, _ = account(*PLAIN)
    rest = f"0,2,0,0,0,0,1,{SOLID.replace(' ', ',')}"
    csv = write(f"a,0,b,100,{rest}", f"b,101,a,1,{rest}", name="c.csv")
    closures = read_candidates(csv, graph)
    assert closures.robot_a.tolist() == [0, 1] and closures.pose_b.tolist() == [0, 1]
    more = read_candidates(write(*BETWEEN["apart"], name="c.g2o"), graph.maps)
    assert (more.pose_a.tolist(), more.pose_b.tolist()) == ([0, 2], [0, 2])
    with pytest.raises(FileFormatError, match=r"d.g2o:1: pose 7 is in 0 of the maps, expected in"):
        read_candidates(write(solid(0, 7, 1), name="d.g2o"), graph)


def test_candidates_between_maps_in_memory_are_doubted_too(write, account):
    graph, _ = account(lines_of("a"), lines_of("b"))
    path = write("id_a,id_b,x,y,theta,note", "a0,b1,1500,200,90,7", name="c.csv")
    with pytest.warns(InputWarning) as told:
        read_candidates(path, graph)
    lines = [str(one.message) for one in told]
    for part in ("columns left out: note", "theta 90 is more than", "maps of 3 m cannot be meant"):
        assert any(part in line for line in lines), part
