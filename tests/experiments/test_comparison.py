"""Methods beside each other: one Q, one merge for one set, figures against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from pcm_jax import InputError, merge, select
from pcm_jax.evaluation import ate_rmse
from pcm_jax.experiments import Method, called, compare_methods, mean_figures
from pcm_jax.experiments.comparison import BEYOND_THE_PAPER, PAPER
from pcm_jax.simulation import simulate_city

SMALL: dict = {"inliers": 8, "aliased_groups": 1, "aliased_size": 3, "random": 12}


@pytest.fixture(scope="module")
def world():
    return simulate_city(seed=3, poses=120, blocks=3, **SMALL)


@pytest.fixture(scope="module")
def compared(world):
    methods = {
        "pcm": Method("pcm-exact"),
        "no-outliers": PAPER["no-outliers"],
        "dcs": PAPER["dcs"],
        "told": BEYOND_THE_PAPER["dcs-true-start"],
        "everything": BEYOND_THE_PAPER["everything"],
    }
    return compare_methods(world.graph, world.is_true, world.truth, methods=methods)


def test_a_row_is_what_merge_makes_of_the_method(world, compared):
    result = merge(world.graph)
    np.testing.assert_array_equal(compared["pcm"].accepted, result.accepted)
    figures = compared["pcm"].figures
    assert figures["ate_rmse"] == pytest.approx(ate_rmse(result.graph.maps, world.truth), abs=1e-9)
    assert figures["chi2"] == pytest.approx(result.solution.normalized_chi2, rel=1e-9)
    assert figures["accepted"] == result.accepted.sum()


def test_the_reference_and_what_bounds_the_methods(world, compared):
    assert list(compared) == ["pcm", "no-outliers", "dcs", "told", "everything"]
    reference = compared["no-outliers"].figures
    assert (reference["tpr"], reference["fpr"], reference["precision"]) == (1.0, 0.0, 1.0)
    assert reference["translation_mse_from_reference"] == pytest.approx(0.0, abs=1e-18)
    everything = compared["everything"].figures
    assert (everything["tpr"], everything["fpr"]) == (1.0, 1.0)
    assert everything["precision"] == pytest.approx(world.is_true.mean())
    assert everything["chi2"] > 100 * reference["chi2"]


def test_robust_methods_keep_maps_in_one_frame_and_can_be_told_the_truth(compared):
    assert not compared["dcs"].accepted.any()
    assert compared["dcs"].figures["map_translation_mse"] > 1.0
    assert compared["told"].figures["tpr"] == 1.0
    assert compared["told"].figures["ate_rmse"] < 2 * compared["no-outliers"].figures["ate_rmse"]


def test_without_a_truth_there_are_rates_but_no_map_errors(world):
    methods = {"exact": Method("pcm-exact"), "greedy": Method("pcm-heuristic")}
    results = compare_methods(world.graph, world.is_true, methods=methods)
    assert results["exact"].figures["tpr"] == 1.0
    assert "translation_mse" not in results["exact"].figures
    assert "translation_mse_from_reference" in results["exact"].figures
    with pytest.raises(InputError, match="truth: None"):
        told = {"told": BEYOND_THE_PAPER["dcs-true-start"]}
        compare_methods(world.graph, world.is_true, methods=told)


def test_confidence_and_options_reach_the_method(world):
    methods = {f"{p}": Method("pcm-exact", p) for p in (0.05, 0.99)}
    results = compare_methods(world.graph, world.is_true, methods=methods)
    for label, method in methods.items():
        chosen = select(world.graph, confidence=method.confidence).accepted
        np.testing.assert_array_equal(results[label].accepted, chosen)
    assert results["0.05"].figures["accepted"] < results["0.99"].figures["accepted"]
    with pytest.raises(InputError, match="nonsense"):
        wrong = {"wrong": Method("scgp", options=(("nonsense", 1),))}
        compare_methods(world.graph, world.is_true, methods=wrong)


def test_means_over_graphs(compared):
    means = mean_figures([compared, compared])
    assert means == {label: each.figures for label, each in compared.items()}


def test_a_wrong_mask_is_named(world):
    with pytest.raises(InputError, match=r"is_true: int64 \[3\] given, expected bool \[23\]"):
        compare_methods(world.graph, np.arange(3))


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("pcm-exact-11", "PCM, 11 %"),
        ("pcm-heuristic-99", "PCM-HeuPatt, 99 %"),
        ("ransac-3.5", "RANSAC, 3.5 %"),
        ("scgp-binary", "SCGP, binary"),
        ("no-outliers", "no outliers"),
        ("pcm-exact", "PCM"),
        ("one-of-my-own", "one-of-my-own"),
    ],
)
def test_a_method_has_one_name(label, name):
    assert called(label) == name
    assert len({called(each) for each in PAPER | BEYOND_THE_PAPER}) == len(PAPER | BEYOND_THE_PAPER)
