"""`IncrementalPcm`: what it answers, what it costs, what it refuses, what it keeps."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time

import numpy as np
import pytest
from online_worlds import assert_same_answer, begun, edges_at, turned, without_closures

import pcm_jax
from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files import read_graph
from pcm_jax.graph import LoopClosures
from pcm_jax.mapping import MapCovariance, covariance
from pcm_jax.online import IncrementalPcm, _answer, _pair, _state
from pcm_jax.pipeline import merge, select
from pcm_jax.simulation import simulate_city

RDM = "multirobot_rdm/pairwise_consistency_maximization/spoiled/simulation/example_4robots"


@pytest.fixture(scope="module")
def graph():
    return simulate_city(
        seed=2, poses=60, robots=3, inliers=8, aliased_groups=1, aliased_size=3, random=9
    ).graph


@pytest.fixture
def online(graph):
    return IncrementalPcm(graph)


def counting(monkeypatch, owner, name):
    """Counts the calls of a function."""
    real, calls = getattr(owner, name), []

    def counted(*args, **kwargs):
        calls.append(args)
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, name, counted)
    return calls


def test_a_graph_with_closures_is_the_batch(graph, online):
    assert_same_answer(online.result(), select(graph))
    assert online.result() is online.result()
    assert (len(online), online.repeated, len(online.waiting)) == (len(graph.closures), 0, 0)


def test_the_public_name():
    assert pcm_jax.IncrementalPcm is IncrementalPcm


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_in_any_order_it_ends_with_the_batch(graph, seed):
    order = np.random.default_rng(seed).permutation(len(graph.closures))
    online = IncrementalPcm(without_closures(graph))
    for step, closure in enumerate(order):
        assert online.add(graph.closures[[closure]]).tolist() == [step]
    shuffled = dataclasses.replace(graph, closures=graph.closures[order])
    assert_same_answer(online.result(), select(shuffled))


@pytest.mark.slow
def test_a_real_set_in_random_order(shared_data):
    """Four robots of Argos, half of the closures of every pair spoiled."""
    given = read_graph(*sorted((shared_data / RDM).glob("*.g2o.xz")))
    order = np.random.default_rng(0).permutation(len(given.closures))
    online = IncrementalPcm(without_closures(given), confidence=0.99)
    for closure in order:
        online.add(given.closures[[closure]])
    batch = select(dataclasses.replace(given, closures=given.closures[order]), confidence=0.99)
    assert_same_answer(online.result(), batch)
    assert 2 * batch.accepted.sum() == len(order)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"method": "clipper"},
        {"metric": "mahalanobis"},
        {"method": "jcbb"},
        {"method": "combinatorial", "minimum_inliers": 4},
        {"time_limit": 30.0},
        {"memory_limit": 0, "tie_break": "distance"},
        {"method": lambda evidence, gate: evidence.consistent(gate).sum(axis=1) > 4},
        {"metric": lambda a, b, closures: np.abs(np.subtract.outer(*[closures.pose_a * 1.0] * 2))},
    ],
)
def test_other_methods_and_metrics_are_asked_anew(graph, options):
    some = graph.closures[np.arange(0, len(graph.closures), 2)]
    online = IncrementalPcm(dataclasses.replace(graph, closures=some), **options)
    online.result()
    online.add(graph.closures[1:6:2])
    online.remove([3])
    assert_same_answer(online.result(), select(online.graph, **options))


@pytest.mark.slow
def test_weights_decide_as_in_the_batch(graph):
    weight = np.random.default_rng(0).uniform(0.0, 2.0, len(graph.closures))
    weighted = dataclasses.replace(
        graph, closures=dataclasses.replace(graph.closures, weight=weight)
    )
    online = IncrementalPcm(without_closures(graph))
    for row in range(len(weighted.closures)):
        online.add(weighted.closures[[row]])
    found = online.result()
    assert found.pairs[0].weight is not None
    assert_same_answer(found, select(weighted))
    with pytest.warns(InputWarning, match="differ in it, which method 'ransac' takes no notice"):
        IncrementalPcm(weighted, method="ransac").result()


def test_what_did_not_change_is_not_asked_again(graph, online, monkeypatch):
    chance = counting_doubts(monkeypatch)
    online.result()
    assert len(chance) == 3
    solves = counting(monkeypatch, covariance, "covariance_factor")
    chance.clear()
    online.remove([closure_of(graph, 0, 1)])
    online.result()
    assert [(one.robot_a, one.robot_b) for one in chance] == [(0, 1)]
    assert solves == []


def closure_of(graph, a, b):
    """The first closure between two robots."""
    return int(graph.closures.between(a, b)[1][0])


def counting_doubts(monkeypatch):
    asked = []

    def chance(evidence, *args, **kwargs):
        asked.append(evidence)
        return real.chance(evidence, *args, **kwargs)

    real = _answer.AS_ASKED
    monkeypatch.setattr(_answer, "AS_ASKED", real._replace(chance=chance))
    return asked


def test_adding_costs_neither_doubts_nor_distances(graph, monkeypatch):
    online = IncrementalPcm(without_closures(graph))
    chance = counting_doubts(monkeypatch)
    together = counting(monkeypatch, _pair, "problem_from_covariances")
    for row in range(20):
        online.add(graph.closures[[row]])
    assert chance == together == []
    pair = online.result().pairs[0]
    assert together == []
    np.testing.assert_allclose(pair.squared, select(online.graph).pairs[0].squared, rtol=1e-7)
    assert len(together) == 1


def test_many_at_once_are_weighed_at_once(graph, monkeypatch):
    monkeypatch.setattr(_pair, "MANY", 4)
    online = IncrementalPcm(dataclasses.replace(graph, closures=graph.closures[:30]))
    for rows in (slice(30, 32), slice(32, None)):
        online.add(graph.closures[rows])
    assert_same_answer(online.result(), select(graph))


def test_repeated_closures_count_once(graph, online):
    again = LoopClosures.concatenate([graph.closures[[4]], turned(graph.closures[[7, 4]])])
    assert online.add(again).tolist() == [4, 7, 4]
    assert (online.repeated, len(online)) == (3, len(graph.closures))
    online.remove([4])
    new = online.add(LoopClosures.concatenate([turned(graph.closures[[4]]), again]))
    last = len(graph.closures) - 1
    assert new.tolist() == [last, last, 6, last]
    assert online.repeated == 6
    assert_same_answer(online.result(), select(online.graph))


def test_closures_wait_for_their_poses(graph):
    maps = tuple(begun(one, 30) for one in graph.maps)
    online = IncrementalPcm(dataclasses.replace(without_closures(graph), maps=maps))
    closures = graph.closures
    later = np.maximum(closures.pose_a, closures.pose_b) >= 30
    found = online.add(closures)
    assert ((found == -1) == later).all() and later.any()
    assert online.add(closures[later]).tolist() == [-1] * later.sum()
    assert (len(online.waiting), online.result().waiting) == (later.sum(), later.sum())
    entered = [
        online.extend(robot, **edges_at(one, pose, odometry=True))
        for robot, one in enumerate(graph.maps)
        for pose in range(30, 60)
    ]
    assert len(online.waiting) == 0 and len(online) == len(closures)
    np.testing.assert_array_equal(np.concatenate(entered), np.arange((~later).sum(), len(closures)))
    assert_same_answer(online.result(), select(online.graph))


def test_the_queue_is_bounded(graph):
    maps = tuple(begun(one, 2) for one in graph.maps)
    few = dataclasses.replace(without_closures(graph), maps=maps)
    online = IncrementalPcm(few, most_waiting=3)
    online.add(graph.closures[:3])
    with pytest.raises(InputError, match="4 would wait for poses that have not come"):
        online.add(graph.closures[[3]])
    assert len(online.waiting) == 3
    assert online.add(graph.closures[[1]]).tolist() == [-1]


@pytest.mark.slow
def test_odometry_leaves_distances_alone(graph, monkeypatch):
    online = IncrementalPcm(graph)
    before = online.result()
    factors = counting(monkeypatch, covariance, "covariance_factor")
    rebuilt = counting(monkeypatch, _pair.HeldPair, "rebuilt")
    step = edges_at(graph.maps[0], 20, odometry=True)
    del step["tail"], step["head"]
    online.extend("a", **step)
    one = graph.closures[[closure_of(graph, 0, 1)]]
    new = dataclasses.replace(one, pose_a=np.array([60]))
    assert one.robot_a == 0
    assert online.add(new).tolist() == [len(graph.closures)]
    assert factors == rebuilt == []
    assert online.graph.maps[0].num_poses == 61
    after = online.result()
    assert after.pairs[0].found == before.pairs[0].found
    assert_same_answer(after, select(online.graph))


@pytest.mark.slow
def test_a_loop_weighs_its_maps_pairs_again(graph, monkeypatch):
    maps = (begun(graph.maps[0], 60).with_edges(np.arange(59)), *graph.maps[1:])
    online = IncrementalPcm(dataclasses.replace(graph, maps=maps))
    online.result()
    rebuilt = counting(monkeypatch, _pair.HeldPair, "rebuilt")
    loops = graph.maps[0].with_edges(np.arange(59, graph.maps[0].num_edges))
    online.extend(
        0,
        tail=loops.tail,
        head=loops.head,
        measurement=loops.measurement,
        information=loops.information,
    )
    assert rebuilt == []
    assert_same_answer(online.result(), select(online.graph))
    assert sorted(pair.robots for pair, _ in rebuilt) == [(0, 1), (0, 2)]


def test_robots_that_come(graph):
    two = dataclasses.replace(without_closures(graph), maps=graph.maps[:2])
    between = (graph.closures.robot_a < 2) & (graph.closures.robot_b < 2)
    online = IncrementalPcm(dataclasses.replace(two, closures=graph.closures[between]))
    with pytest.raises(InputError, match="robot 2 of 2 does not exist"):
        online.add(graph.closures[~between])
    online.replace_maps([*online.graph.maps, graph.maps[2]])
    online.add(graph.closures[~between])
    assert_same_answer(online.result(), select(online.graph))


@pytest.mark.parametrize("refine", [None, "recall"])
def test_merged_as_the_batch_merges(graph, online, refine):
    found, batch = online.merge(refine=refine), merge(graph, refine=refine)
    np.testing.assert_array_equal(found.accepted, batch.accepted)
    assert found.groups == batch.groups and found.method == batch.method
    assert (found.confidence, found.gate) == (batch.confidence, batch.gate)
    assert found.solution.cost == pytest.approx(batch.solution.cost, rel=1e-9)
    np.testing.assert_allclose(
        lie.parameters(found.anchors), lie.parameters(batch.anchors), atol=1e-8
    )
    assert found.explain(0).standing == batch.explain(0).standing
    with pytest.raises(InputError, match="method: not an option of merge here"):
        online.merge(method="dcs")


@pytest.mark.slow
def test_a_step_that_fails_leaves_all_as_it_was(graph, monkeypatch):
    online = IncrementalPcm(dataclasses.replace(graph, closures=graph.closures[:40]))
    before, told = online.result(), repr(online)

    def fail(self, pose):
        raise InputError("a map that cannot be factorised")

    with monkeypatch.context() as broken:
        broken.setattr(MapCovariance, "own", fail)
        with pytest.raises(InputError, match="cannot be factorised"):
            online.add(graph.closures[40:44])
    assert (repr(online), online.result()) == (told, before)

    real, calls = _pair.GrowingClique.add, []

    def interrupted(self, agrees):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, agrees)

    with monkeypatch.context() as broken:
        broken.setattr(_pair.GrowingClique, "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            online.add(graph.closures[40:46])
    assert (repr(online), online.result()) == (told, before)
    online.add(graph.closures[40:])
    assert_same_answer(online.result(), select(graph))


BAD = [
    (lambda o, g: o.add(None), "closures: NoneType given"),
    (lambda o, g: o.remove([99]), "indices: 99 given, expected 0 … 59"),
    (lambda o, g: o.remove([1, 1]), "indices: 1 given twice"),
    (lambda o, g: o.remove([0.5]), "indices: float64"),
    (lambda o, g: o.remove(np.zeros(3, bool)), r"indices: shape \(3,\), expected \(60,\)"),
    (lambda o, g: o.extend("z", measurement=[]), "robot: 'z' given, expected 0 … 2 or one of a"),
    (lambda o, g: o.extend(True, measurement=[]), "robot: True given"),
    (lambda o, g: extended(o, g, ids=[3]), r"ids\[0\]: 3 is taken"),
    (lambda o, g: extended(o, g, tail=[59]), "tail, head: give both"),
    (lambda o, g: extended(o, g, tail=[60], head=[61]), "not connected|no edge|reach|connect"),
    (lambda o, g: extended(o, g, information=None), "give exactly one of the two"),
    (lambda o, g: extended(o, g, stamps=[1.0, 2.0]), r"stamps: shape \(2,\) given"),
    (lambda o, g: o.replace_maps(g.maps[:2]), "maps: 2 given, expected at least 3"),
    (lambda o, g: o.replace_maps([begun(m, 5) for m in g.maps]), "pose .* does not exist"),
    (lambda o, g: o.replace_maps(5), "maps: int given"),
]


def extended(online, graph, **changed):
    step = edges_at(graph.maps[0], 20, odometry=True)
    del step["tail"], step["head"]
    return online.extend(0, **step | changed)


@pytest.mark.parametrize(("call", "message"), BAD)
def test_what_is_refused(graph, online, call, message):
    state = online._state
    with pytest.raises(InputError, match=message):
        call(online, graph)
    assert online._state is state


def test_stamps_come_in_order(graph):
    stamped = dataclasses.replace(graph.maps[0], stamps=np.arange(60.0))
    online = IncrementalPcm(dataclasses.replace(graph, maps=(stamped, *graph.maps[1:])))
    extended(online, graph, stamps=[59.5])
    extended(online, graph)
    with pytest.raises(InputError, match=r"stamps\[0\]: 58 s after 59.5 s, expected them in order"):
        extended(online, graph, stamps=[58.0])
    assert online.graph.maps[0].stamps.tolist()[-2] == 59.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "best"}, "method: 'best'"),
        ({"confidence": 1.5}, "confidence: 1.5"),
        ({"most_waiting": -1}, "most_waiting: -1"),
        ({"weights": np.ones(3)}, "weights: not an option"),
        ({"minimum_inliers": 2, "seed": 3}, "seed: 3 given with minimum_inliers"),
    ],
)
def test_bad_options(graph, options, message):
    with pytest.raises(InputError, match=message):
        IncrementalPcm(graph, **options)


def test_saved_and_loaded(graph, tmp_path):
    labelled = dataclasses.replace(graph.closures, is_true=np.arange(len(graph.closures)) % 2 == 0)
    stamped = dataclasses.replace(graph.maps[0], stamps=np.arange(60.0))
    given = dataclasses.replace(graph, maps=(stamped, *graph.maps[1:]), closures=labelled)
    online = IncrementalPcm(given, confidence=0.9, seed=3, most_waiting=7)
    far = dataclasses.replace(graph.closures[[0]], pose_a=np.array([70]))
    online.add(far)
    online.add(graph.closures[[2]])
    online.save(tmp_path / "state.npz")
    loaded = IncrementalPcm.load(tmp_path / "state.npz")
    assert repr(loaded) == repr(online)
    assert_same_answer(loaded.result(), online.result())
    np.testing.assert_array_equal(loaded.graph.closures.is_true, labelled.is_true)
    np.testing.assert_array_equal(loaded.graph.maps[0].stamps, stamped.stamps)
    for one in (online, loaded):
        assert one.add(graph.closures[[2]]).tolist() == [2]
        assert one.add(far).tolist() == [-1]
        one.remove([0, 5])
    assert_same_answer(loaded.result(), online.result())
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"]


def test_functions_are_not_saved(graph, tmp_path):
    online = IncrementalPcm(graph, method=lambda evidence, gate: np.ones(len(evidence), bool))
    with pytest.raises(InputError, match="method: a function given"):
        online.save(tmp_path / "state.npz")
    assert not list(tmp_path.iterdir())


def test_broken_states_are_refused(online, tmp_path):
    path = tmp_path / "state.npz"
    online.save(path)
    whole = path.read_bytes()
    for broken in (b"", b"no zip", whole[: len(whole) // 2], whole[:-20]):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match="not a state that IncrementalPcm saved"):
            IncrementalPcm.load(path)
    entry, end = whole.index(b"PK\x01\x02"), whole.rindex(b"PK\x05\x06")
    for where, bits in (  # where the directory begins; an encrypted entry; an unknown compression
        (end + 16, b"\xff\xff\xff\x7f"),
        (entry + 8, b"\x01"),
        (entry + 10, b"\x63"),
    ):
        path.write_bytes(whole[:where] + bits + whole[where + len(bits) :])
        with pytest.raises(FileFormatError, match="not a state that IncrementalPcm saved"):
            IncrementalPcm.load(path)
    path.write_bytes(whole)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, allow_pickle=False, **arrays | {"held.pose_a": arrays["held.pose_a"] + 1})
    with pytest.raises(FileFormatError, match="changed since it was written"):
        IncrementalPcm.load(path)
    np.savez(path, allow_pickle=False, x=np.zeros(3))
    with pytest.raises(FileFormatError, match="not a state"):
        IncrementalPcm.load(path)
    with pytest.raises(OSError, match="nowhere"):
        IncrementalPcm.load(tmp_path / "nowhere.npz")


SAVING = """
import sys
from pcm_jax.online import IncrementalPcm
online = IncrementalPcm.load(sys.argv[1])
print("begins", flush=True)
while True:
    online.save(sys.argv[1])
"""


@pytest.mark.slow
def test_killed_while_saving_the_last_state_loads(online, tmp_path):
    path = tmp_path / "state.npz"
    online.save(path)
    command = [sys.executable, "-c", SAVING, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "begins\n"
        time.sleep(0.3)
        process.kill()
    assert repr(IncrementalPcm.load(path)) == repr(online)


def test_a_state_shares_what_did_not_change(graph, online):
    before, one = online._state, graph.closures[[closure_of(graph, 0, 1)]]
    online.add(dataclasses.replace(one, pose_a=one.pose_a + 1))
    after = online._state
    assert isinstance(before, _state.State)
    assert after.pairs[0, 2] is before.pairs[0, 2]
    assert after.pairs[0, 1] is not before.pairs[0, 1]
    assert len(before.pairs[0, 1]) + 1 == len(after.pairs[0, 1])


def moving(graph, factor):
    """The maps after one edge in the middle of the first is measured more finely."""
    one = graph.maps[0]
    information = np.array(one.information)
    information[40] *= factor
    return [dataclasses.replace(one, information=information), *graph.maps[1:]]


@pytest.mark.parametrize("factor", [1.001, 1.2, 3.0])
def test_only_what_moved_is_measured_anew(graph, monkeypatch, factor):
    online = IncrementalPcm(graph, tolerance=0.1)
    online.result()
    rebuilt = counting(monkeypatch, _pair.HeldPair, "rebuilt")
    rows = counting(monkeypatch, _pair.GrowingPair, "agreeing")
    was = {robots: pair._growing for robots, pair in online._state.pairs.items()}
    online.replace_maps(moving(online.graph, factor))
    found, measured = online.result(), len(rows)
    plain = IncrementalPcm(online.graph)
    for robots, pair in plain._state.pairs.items():
        moved = was[robots].moved_to(pair._growing)
        squared = pair.evidence().squared
        before = select(graph).pairs[sorted(plain._state.pairs).index(robots)].evidence.squared
        near = np.minimum(before, squared) <= pair.gate
        apart = np.abs(np.sqrt(before) - np.sqrt(squared))[near]
        bound = (moved[:, None] + moved[None])[near]
        assert (apart <= 1.05 * bound + 1e-9).all()
        assert robots[0] == 0 or moved.max() < 1e-6
    assert_same_answer(found, select(online.graph))
    pairs = [pair.robots for pair, _ in rebuilt]
    assert (1, 2) not in pairs and (len(rebuilt) == 0) == (factor == 1.001)
    assert (measured == 0) == (factor == 1.001)


def test_few_that_moved_are_measured_row_by_row(graph, monkeypatch):
    online = IncrementalPcm(graph, tolerance=1e-3)
    online.result()
    monkeypatch.setattr(_pair, "MOST_MOVED", 1.0)
    monkeypatch.setattr(_pair.HeldPair, "rebuilt", pytest.fail)
    rows = counting(monkeypatch, _pair.GrowingPair, "agreeing")
    online.replace_maps(moving(online.graph, 3.0))
    assert_same_answer(online.result(), select(online.graph))
    assert len(rows) > 10


def test_the_tolerance_is_saved(graph, tmp_path):
    IncrementalPcm(graph, tolerance=0.25).save(tmp_path / "state.npz")
    assert IncrementalPcm.load(tmp_path / "state.npz")._state.tolerance == 0.25
    with pytest.raises(InputError, match="tolerance: -1"):
        IncrementalPcm(graph, tolerance=-1)
