"""Calls with objects of wrong classes: an `InputError` names the argument, or the call works.

Each public function is called rightly but for one argument, which is one of these objects. A short
form: a seeded sample of all such calls.
"""

import warnings

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import pcm_jax as pcm
from pcm_jax.simulation import simulate_city

SAMPLE, SEED = 400, 0


class Empty:
    """An object of nobody's."""


GRAPH = simulate_city(seed=0, poses=16, inliers=4, random=3).graph
MAP = GRAPH.maps[0]
CLOSURES, _ = GRAPH.closures.between(0, 1)
HOSTILE = (
    *(None, Empty(), "text", b"x", 3, -1, 2.5, float("nan"), 1j, True, 10**30),
    *([], [None], (), {}, {"a": 1}, range(3), [[1], [2, 3]], MAP, CLOSURES, GRAPH),
    *(np.zeros(0), np.zeros(3), np.zeros((2, 2)), np.zeros((1,) * 9), np.full((3, 3), np.nan)),
    *(np.array(["a"]), np.array([1j]), np.array([None]), np.array(10**30, dtype=object)),
    *(np.ma.masked_array([1.0, 2.0], [0, 1]), jaxlie.SE3.identity(), jnp.zeros((2, 3, 4))),
)


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    """Right calls: function, positional and keyword arguments."""
    evidence = pcm.weigh(GRAPH)
    pair, maps = evidence.pairs[0], evidence.maps
    problem = pcm.consistency_problem(*maps, CLOSURES)
    squared = np.asarray(pcm.squared_mahalanobis(problem))
    consistent = pcm.consistency_graph(squared, 11.3)
    accepted = np.arange(len(GRAPH.closures)) < 4
    result = pcm.merge(evidence, accepted=accepted)
    folder = tmp_path_factory.mktemp("hostile")
    edges = ("tail", "head", "measurement", "information", "ids", "name")
    ends = ("robot_a", "pose_a", "robot_b", "pose_b", "measurement", "information")
    of_map = {name: getattr(MAP, name) for name in edges}
    of_closures = {name: getattr(CLOSURES, name) for name in ends}
    by_id = {name.replace("pose", "id"): value for name, value in of_closures.items()}
    sigmas = {"sigma_translation": 0.1, "sigma_rotation": 0.1}
    by_chance = {"significance": 0.01, "separation": 5.0, "seed": 0, "time_limit": 1.0}
    read = {"information": "as-written", "ids": "auto", "repair": None, "default_sigmas": (1, 1)}
    return [
        (pcm.merge, [evidence], {"accepted": accepted}),
        (pcm.select, [evidence], {"confidence": 0.99, "minimum_inliers": 2}),
        (pcm.select, [evidence], {"on_ambiguous": "split", **by_chance}),
        (pcm.weigh, [GRAPH], {"memory_limit": 1e9}),
        (pcm.optimize, [MAP], {"initial": "given", "solver": "gauss-newton", "engine": "blocks"}),
        (pcm.joint_marginal_covariance, [MAP, [0, 1]], {}),
        (pcm.MapCovariance, [MAP], {}),
        (pcm.consistency_problem, [*maps, CLOSURES], {}),
        (pcm.squared_mahalanobis, [problem], {"kernel": "closed-form"}),
        (pcm.stream_consistency_graph, [*maps, CLOSURES, 11.0], {}),
        (pcm.chi2_gate, [0.99, 3], {}),
        (pcm.consistency_graph, [squared, 11.0], {}),
        (pcm.to_networkx, [consistent, squared], {}),
        (pcm.maximum_clique, [consistent], {"method": "exact", "time_limit": 1.0}),
        (pcm.maximum_clique, [consistent], {"tie_break": squared}),
        (pcm.maximum_clique, [consistent], {"weights": np.ones(len(squared))}),
        (pcm.select_from, [squared, 11.0], {}),
        (pcm.soft_select, [squared, 11.0], {"temperature": 1.0}),
        (pcm.joint_consistency, [pair, [0, 1]], {}),
        (pcm.alignment_difference, [pair, [0, 1], [2, 3]], {}),
        (pcm.split, [MAP, [5]], {}),
        (pcm.pad_graph, [GRAPH], {"poses": 32, "edges": 64, "closures": 32}),
        (pcm.PoseGraph.from_arrays, [], {"poses": MAP.poses, **of_map}),
        (pcm.PoseGraph.from_trajectory, [MAP.poses], sigmas),
        (pcm.LoopClosures.from_arrays, [], {"source": CLOSURES.source, **of_closures}),
        (pcm.LoopClosures.from_ids, [GRAPH.maps], by_id),
        (pcm.LoopClosures.concatenate, [[CLOSURES, CLOSURES]], {}),
        (pcm.MultiRobotGraph, [GRAPH.maps, GRAPH.closures], {}),
        (pcm.read_graph, [folder / "none.g2o"], read),
        (pcm.write_g2o, [folder / "x.g2o", GRAPH], {"ids": "original"}),
        (pcm.write_trajectory, [folder / "x.txt", MAP], {"timestamps": None}),
        (pcm.select_within, [MAP], {}),
        (pcm.clean_maps, [GRAPH], {}),
        (pcm.true_positive_rate, [accepted, accepted], {}),
        (pcm.ate_rmse, [MAP.poses, MAP.poses], {}),
        (pcm.merge_differentiable, [GRAPH, np.ones(len(GRAPH.closures))], {}),
        (result.marginals, [0, [0, 1]], {}),
    ]


def test_only_input_errors_come(calls, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # "text" is a path, too
    every = [
        (number, slot, value)
        for number, (_, given, named) in enumerate(calls)
        for slot in (*range(len(given)), *named)
        for value in HOSTILE
    ]
    chosen = np.random.default_rng(SEED).permutation(len(every))[:SAMPLE]
    wrong = []
    for number, slot, value in (every[index] for index in chosen):
        function, given, named = calls[number]
        given, named = list(given), dict(named)
        (given if isinstance(slot, int) else named)[slot] = value
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                function(*given, **named)
        except pcm.InputError as error:
            assert "\n" not in str(error)
        except Exception as error:
            wrong.append((function.__name__, slot, repr(value)[:40], repr(error)[:80]))
    assert wrong == []
