"""Training in small: through the check, the selection and the merge, on worlds of the benchmark."""

import jax
import numpy as np
import pytest

from benchmarks import learning
from benchmarks.experiments import learning_model as model
from benchmarks.experiments.learning_worlds import COUNTS, worlds

pytest.importorskip("optax")


@pytest.fixture(scope="module")
def known():
    return worlds(0, 12)


@pytest.fixture(scope="module")
def new():
    return worlds(1, 12)


def test_worlds_are_what_they_say(known):
    """Twelve of 64 are right, with errors of the stated size; slipped ones are far outside."""
    assert known.right.shape == (12, sum(COUNTS.values()))
    np.testing.assert_array_equal(known.right.sum(axis=1), COUNTS["true"])
    squared = np.sum((known.error / known.sigma) ** 2, axis=-1)
    mean = squared[known.right].mean()  # of 144 draws of chi-squared with 3 degrees of freedom
    assert abs(mean - 3.0) < 4.0 * np.sqrt(6.0 / known.right.sum())
    assert squared[~known.right].min() > 20.0
    ratio = known.sigma[known.right].max() / known.sigma[known.right].min()
    assert ratio > 20.0


def test_worlds_are_reproducible(known):
    for one, other in zip(jax.tree.leaves(worlds(0, 2)), jax.tree.leaves(known), strict=True):
        np.testing.assert_array_equal(one, other[:2])


def test_a_threshold_keeps_its_promise():
    scores, right = np.arange(10.0), np.arange(10) % 2 == 0  # false: 9, 7, 5, 3, 1
    for rate, passing in ((0.0, 0), (0.19, 0), (0.2, 1), (0.5, 2)):
        threshold = learning.threshold_at(rate, scores, right)
        assert (scores[~right] > threshold).sum() == passing


def true_rate(scores, right):
    """At a false positive rate of 1 %."""
    return (scores[right] > learning.threshold_at(0.01, scores, right)).mean()


@pytest.mark.slow
def test_training_through_everything(known, new):
    """First by selection, then by the map as well: both losses fall, on new worlds too."""
    start = model.Judge(jax.random.key(0))
    judge, losses = model.fit(model.selection, known, seed=0, steps=80, batch=6)
    assert losses[-10:].mean() < 0.5 * losses[:10].mean()
    plain, _ = model.fit(model.classifier, known, seed=0, steps=80, batch=6)
    rates = {
        "start": true_rate(learning._selected(new, learning._judged(start, new))[0], new.right),
        "trained": true_rate(learning._selected(new, learning._judged(judge, new))[0], new.right),
        "classifier": true_rate(np.asarray(learning._judged(plain, new).score), new.right),
    }
    assert rates["trained"] > rates["start"]
    assert rates["trained"] > rates["classifier"] + 0.3
    _, whole = model.fit(model.through, known, seed=0, steps=8, batch=12, rate=2e-3, start=judge)
    assert np.isfinite(whole).all()
    assert whole[-1] < whole[0]  # every batch is all worlds
