"""Doubts: what chance does, what else explains the closures, and so what is believed.

places       closures beside each other along both ways are one witness
chance       how often closures of which none is right agree as well
rivals       the best set that implies another alignment
odometry     the scale of odometry's errors, as the closures inside one map tell it
within       how often closures of which none is right agree with odometry inside one map
verdict      what is believed, all pairs of robots together, and why
team         cycles of robots: whether the alignments of a team's pairs fit together
variance_components  the factors on stated variances, by restricted likelihood
loop_lengths  odometry's errors by the length of loops, where no one factor holds for all
calibration  `Calibration`: these factors, in numbers and in words
residuals    what is left of closures in the merged maps; the edges strained most
_loops       by how much the loops of chosen pairs of closures miss, and through whose errors
_standing    the standing of a closure among the others: agreements, the worst conflict
_sentences   explanations in words
explanation  why each closure was accepted or rejected
_mistakes    usual mistakes in what closures say and join, and closures without them
_screen      a first look at many readings of the closures, those by mistakes undone
_solved_mistakes     the same where something unknown is to be found: degrees, a sensor's place
triage       where nearly all is rejected, the mistake that explains it
"""

from pcm_jax.integrity._standing import STANDINGS, Conflict
from pcm_jax.integrity.calibration import Calibration, Factor, Factors
from pcm_jax.integrity.chance import SIGNIFICANCE, ChanceLevel, chance_level
from pcm_jax.integrity.explanation import Explanation, explain
from pcm_jax.integrity.places import Places, places_of, way_of
from pcm_jax.integrity.residuals import Fit, StrainedEdge, strained_edges
from pcm_jax.integrity.rivals import Rival, strongest_rival
from pcm_jax.integrity.team import Cycle, alignments_of, cycles_of, judge_team, minority
from pcm_jax.integrity.triage import Finding, triage
from pcm_jax.integrity.verdict import (
    AS_ASKED,
    Doubts,
    Verdict,
    holm,
    judge_by_chance,
    judge_by_number,
)

__all__ = [
    "AS_ASKED",
    "SIGNIFICANCE",
    "STANDINGS",
    "Calibration",
    "ChanceLevel",
    "Conflict",
    "Cycle",
    "Doubts",
    "Explanation",
    "Factor",
    "Factors",
    "Finding",
    "Fit",
    "Places",
    "Rival",
    "StrainedEdge",
    "Verdict",
    "alignments_of",
    "chance_level",
    "cycles_of",
    "explain",
    "holm",
    "judge_by_chance",
    "judge_by_number",
    "judge_team",
    "minority",
    "places_of",
    "strained_edges",
    "strongest_rival",
    "triage",
    "way_of",
]
