"""Doubts: what chance does, what else explains the closures, and so what is believed.

places   closures beside each other along both ways are one witness
chance   how often closures of which none is right agree as well
rivals   the best set that implies another alignment
odometry  the scale of odometry's errors, as the closures inside one map tell it
within   how often closures of which none is right agree with odometry inside one map
verdict  what is believed, all pairs of robots together, and why
variance_components  the factors on stated variances, by restricted likelihood
calibration  `Calibration`: these factors, in numbers and in words
team     cycles of robots: whether the alignments of a team's pairs fit together
"""

from pcm_jax.integrity.calibration import Calibration, Factor, Factors
from pcm_jax.integrity.chance import SIGNIFICANCE, ChanceLevel, chance_level
from pcm_jax.integrity.places import Places, places_of, way_of
from pcm_jax.integrity.rivals import Rival, strongest_rival
from pcm_jax.integrity.team import Cycle, cycles_of, judge_team, minority
from pcm_jax.integrity.verdict import Verdict, holm, judge_by_chance, judge_by_number

__all__ = [
    "SIGNIFICANCE",
    "Calibration",
    "ChanceLevel",
    "Cycle",
    "Factor",
    "Factors",
    "Places",
    "Rival",
    "Verdict",
    "chance_level",
    "cycles_of",
    "holm",
    "judge_by_chance",
    "judge_by_number",
    "judge_team",
    "minority",
    "places_of",
    "strongest_rival",
    "way_of",
]
