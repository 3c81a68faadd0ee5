"""The text of a merge: what came near, how far each pair is to be believed, what to do next."""

import copy
import json

import pytest

from pcm_jax.cli._advice import advice
from pcm_jax.cli._summary import NOTHING, summary

PAIR = {
    "a": "a",
    "b": "b",
    "measured": 20,
    "accepted": 6,
    "optimal": True,
    "upper_bound": 6,
    "found": 6,
    "places": 5,
    "chance": 0.0099,
    "rival": None,
    "ambiguous": False,
    "joint": {"chi2": 14.0, "dof": 15, "p": 0.52},
    "why": "6 of 20 closures agree, at 5 places; chance does as well with p = 0.0099",
}
RIVAL = {"size": 4, "places": 2, "shared": 0, "alignment": {}, "chance": None}


def closure(index, agrees_with=0, enters_at=1.0, accepted=False, among="accepted", of=6):
    worst = {"with": 1, "squared": 50.0, "translation": 12.345, "rotation": 40.0}
    return {
        "index": index,
        "a": f"a{index}",
        "b": f"b{index}",
        "accepted": accepted,
        "agrees_with": agrees_with,
        "of": of,
        "among": among,
        "enters_at": enters_at,
        "worst_conflict": worst | {"translation_sigma": 0.81, "rotation_sigma": 2.0},
    }


@pytest.fixture
def report():
    return copy.deepcopy(
        {
            "robots": [{"name": name, "poses": 60, "edges": 80} for name in "ab"],
            "anchors": [{"x": 0.0, "y": 0.0, "theta": 0.0}] * 2,
            "groups": [["a", "b"]],
            "robot_pairs": [PAIR],
            "closures": [closure(k, 5, 0.9, accepted=True) for k in range(6)],
            "solution": {
                "cost": 80.0,
                "normalized_chi2": 0.9,
                "iterations": 3,
                "converged": True,
            },
            "team": [],
            "warnings": [],
            "hints": [],
        }
    )


def blocks(report):
    return [block.splitlines() for block in summary(report).split("\n\n")]


def test_every_pair_has_its_evidence(report):
    report["robot_pairs"][0]["rival"] = RIVAL
    robots, pairs, fit, evidence = blocks(report)
    assert robots[0].split()[0] == "robot" and pairs[0].split()[0] == "robots"
    assert fit == ["cost 80 (normalised chi2 0.9), converged after 3 steps"]
    assert evidence[0].split() == ["robots", "found", "places", "chance", "rival", "joint"]
    assert evidence[1].split("  ")[0] == "a - b"
    assert "p = 0.0099  4 at 2 places  p = 0.52" in evidence[1]
    assert evidence[2] == "groups: a + b"


def test_what_no_verdict_was_given_on(report):
    """Robust methods and given closures: there is nothing to say of chance."""
    for name in ("found", "places", "chance", "rival", "ambiguous", "joint", "why"):
        report["robot_pairs"][0][name] = None
    assert blocks(report)[-1] == ["groups: a + b"]


def test_the_most_surprising_rejections(report):
    """The share of the accepted comes first, then the confidence; at most five, and no others."""
    report["closures"] += [
        closure(10, 0, 1.0),  # against all, beyond every gate
        closure(11, 0, 0.9990),
        closure(12, 3, 0.9999),
        closure(13, 3, 0.9950),
        closure(14, 5, 1.0),
        closure(15, 1, 1.0),
        closure(16, 1, 0.9991),
        closure(17, 5, 0.9, among="found"),  # of a pair that was refused as a whole
        closure(18, None, None, of=None),  # not weighed
        closure(19, 0, None, of=0),
    ]
    table = blocks(report)[-1]
    assert table[0].split("  ")[0] == "nearly accepted"
    assert [int(line.split()[0]) for line in table[1:]] == [14, 13, 12, 16, 15]
    assert "a14 to b14  5 of 6" in table[1]
    assert "12.3 m, 40° (sigma 0.81 m, 2°)  never" in table[1]
    assert table[2].endswith("0.995")


def test_nothing_came_near(report):
    report["closures"] += [closure(10, 0, 1.0)]
    assert len(blocks(report)) == 4


def refused(report, **changes):
    report["groups"] = [["a"], ["b"]]
    report["anchors"] = [None, None]
    report["robot_pairs"][0] |= {"accepted": 0, "joint": None} | changes
    return report


def test_nothing_to_merge_is_the_first_line(report):
    text = summary(refused(report, found=1, places=1))
    assert text.splitlines()[0] == NOTHING


def test_nothing_odd_no_advice(report):
    assert advice(report) is None


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ({"found": 1}, "check how the closures between a and b are written (pcm-jax inspect)"),
        ({"found": 3}, "find closures between a and b at other places"),
        ({"found": 3, "chance": None}, "(--minimum-inliers 3)"),
        ({"ambiguous": True}, "take the larger set (--on-ambiguous largest)"),
    ],
)
def test_advice_on_robots_apart(report, pair, words):
    told = advice(refused(report, **pair))
    assert told.startswith("next: ")
    assert words in told
    assert summary(report).splitlines()[-1] == told


def test_a_pair_that_others_join_needs_no_advice(report):
    report["robot_pairs"][0] |= {"accepted": 0, "joint": None}
    assert advice(report) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r["solution"].update(converged=False), "--clean-maps"),
        (lambda r: r["robot_pairs"][0].update(optimal=False), "--time-limit"),
        (lambda r: r["robot_pairs"][0]["joint"].update(p=1e-5), "pcm-jax calibrate"),
        (lambda r: r["team"].append({"cycle": ["a", "b", "c"], "chi2": 90.0, "p": 1e-9}), "cycle"),
        (lambda r: r["hints"].append("is it a root (--information sqrt)? It is 1"), "try --infor"),
    ],
)
def test_advice_on_what_is_odd(report, change, words):
    change(report)
    assert words in advice(report)


def test_a_hint_comes_before_its_consequences(report):
    report["hints"].append("do the maps hold false loops (--clean-maps)?")
    report["robot_pairs"][0]["joint"]["p"] = 1e-9
    assert advice(report) == "next: try --clean-maps"


def test_json_on_standard_output(run, city):
    ran = run("merge", city / "graph.g2o", "--json")
    assert ran.status == 0
    printed = json.loads(ran.out)
    assert sum(row["accepted"] for row in printed["closures"]) == 6
    assert printed["hints"] == []
