"""The worth of training through the consistency check and the merge.

    python -m benchmarks.learning --seeds 0 1 2 3 4 --out DIR

A network sees features of each candidate closure and says how noisy it is and how likely right
(`experiments.learning_model`), in cities where neither features nor any one covariance tell right
from wrong (`experiments.learning_worlds`). For every seed, 100 worlds to train on and 120 others to
test. Each method gives each closure a number s in [0, 1]:

- fixed covariances: soft PCM; one scale for all, the best on the training worlds;
- classifier: the network's probability alone;
- classifier + fixed covariances: both, the score inside PCM; again the best scale;
- trained apart: scores by labels and covariances by likelihood, then the same PCM;
- trained through selection: the same, by the cross-entropy of PCM's answer;
- trained through selection and map: and by the map's error;
- true deviations: soft PCM told what no method can know, and nothing of scores.

Accepted is what exceeds a threshold, the least that keeps FPR <= 0.1 % on the training worlds;
where a world has none, the highest s alone, so that there is a map. TPR and FPR are those on the
test worlds; "TPR at 0.1 %" puts the threshold on the test worlds. ATE is that of the map merged by
the accepted closures, and by all weighted by s; methods without covariances of their own use the
best fixed ones. "True closures" merges by nothing else, weighted by their true deviations.

Writes summary.json ({method: mean figures over the seeds}), seeds.csv, table.md, rates.png and
run.json.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.learning_model import (
    Judge,
    Judged,
    all_alike,
    apart,
    classifier,
    each,
    fit,
    map_error,
    selected,
    selection,
    through,
)
from benchmarks.experiments.learning_worlds import LearningWorld, worlds
from benchmarks.experiments.record import (
    LIBRARY,
    means_by_method,
    rows_by_method,
    write_csv,
)
from pcm_jax.arrays import on_host
from pcm_jax.evaluation import comparison_table
from pcm_jax.store import Store, digest, write_json

MOST_FALSE = 1e-3
SCALES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
EXPERIMENTS = Path(__file__).parent / "experiments"
SOURCES = (*LIBRARY, Path(__file__), *sorted(EXPERIMENTS.glob("learning_*.py")))
FALSE_RATES = np.geomspace(2e-4, 0.3, 20)
TRAINED = {
    "trained apart": (apart, 400),
    "trained through selection": (selection, 300),
    "trained through selection and map": (through, 200),
}
"""Losses, and steps of 16 worlds, after which they fall no more."""


Method = Callable[[LearningWorld], tuple[np.ndarray, Judged]]
"""From a stack of worlds to s of all closures, and what is believed of them in the merge."""
COLUMNS = {
    "tpr": "TPR",
    "fpr": "FPR",
    "tpr_at": "TPR at 0.1 %",
    "ate_median": "ATE, median, m",
    "ate_mean": "ATE, mean, m",
    "ate_weighted_median": "weighted: median, m",
    "ate_weighted_mean": "weighted: mean, m",
}


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest((options.train, options.test), files=SOURCES))
    tasks = {
        f"seed-{seed}": partial(run_seed, seed, options.train, options.test)
        for seed in options.seeds
    }
    results = run_tasks("seeds", tasks, steps, jobs=options.jobs)
    summary = means_by_method(results.values())
    write_json(options.out / "summary.json", summary)
    write_csv(options.out / "seeds.csv", rows_by_method(results))
    table = comparison_table(summary, COLUMNS)
    (options.out / "table.md").write_text(table + "\n")
    _draw(list(results.values()), options.out)
    write_run(options.out, options, start)
    print(table)
    return 0


@on_host
def run_seed(seed: int, train: int, test: int) -> dict[str, Any]:
    """Figures of every method, and its true rates at `FALSE_RATES`, for one seed's worlds."""
    known, new = (worlds(part, n) for part, n in ((2 * seed, train), (2 * seed + 1, test)))
    judges = {"classifier": fit(classifier, known, seed=seed, steps=300)[0]}
    for name, (loss, count) in TRAINED.items():
        judges[name] = fit(loss, known, seed=seed, steps=count)[0]
    figures, curves = {}, {}
    for name, method in methods(judges, known).items():
        threshold = threshold_at(MOST_FALSE, method(known)[0], known.right)
        scores, judged = method(new)
        figures[name] = _figures(new, scores, judged, threshold)
        thresholds = [threshold_at(rate, scores, new.right) for rate in FALSE_RATES]
        curves[name] = [float((scores[new.right] > t).mean()) for t in thresholds]
    truly = _alike(new, 1.0)._replace(sigma=new.sigma)
    figures["true closures"] = _figures(new, new.right.astype(float), truly, 0.5)
    return {"methods": figures, "curves": curves}


def methods(judges: Mapping[str, Judge], known: LearningWorld) -> dict[str, Method]:
    """Every method by name; what is to be chosen is chosen on the `known` worlds."""
    plain = judges["classifier"]
    alone = _best_scale(known, lambda data: _alike(data, 1.0).score)
    both = _best_scale(known, lambda data: _judged(plain, data).score)

    def scaled(data: LearningWorld, scale: float, score: Any) -> tuple[np.ndarray, Judged]:
        return _selected(data, _alike(data, scale)._replace(score=score))

    return {
        "fixed covariances": lambda data: scaled(data, alone, _alike(data, alone).score),
        "classifier": lambda data: (
            np.asarray(jax.nn.sigmoid(_judged(plain, data).score)),
            _alike(data, alone),
        ),
        "classifier + fixed covariances": lambda data: scaled(
            data, both, _judged(plain, data).score
        ),
        **{
            name: lambda data, name=name: _selected(data, _judged(judges[name], data))
            for name in TRAINED
        },
        "true deviations": lambda data: _selected(
            data, _alike(data, 1.0)._replace(sigma=data.sigma)
        ),
    }


def threshold_at(most_false: float, scores: Any, right: Any) -> float:
    """The least threshold that at most this share of the false closures exceeds."""
    false = np.sort(np.asarray(scores)[~np.asarray(right)])[::-1]
    return float(false[int(most_false * len(false))])


def _best_scale(known: LearningWorld, score: Callable[[LearningWorld], Any]) -> float:
    """The one of `SCALES` with the highest TPR at FPR <= 0.1 %."""

    def true_rate(scale: float) -> float:
        scores, _ = _selected(known, _alike(known, scale)._replace(score=score(known)))
        return (scores[known.right] > threshold_at(MOST_FALSE, scores, known.right)).mean()

    return max(SCALES, key=true_rate)


def _judged(judge: Judge, data: LearningWorld) -> Judged:
    return jax.vmap(judge)(data.features)


def _alike(data: LearningWorld, scale: float) -> Judged:
    return jax.vmap(lambda world: all_alike(world, scale))(data)


def _selected(data: LearningWorld, judged: Judged) -> tuple[np.ndarray, Judged]:
    return np.asarray(each(selected, data, judged)), judged


def _figures(
    data: LearningWorld, scores: np.ndarray, judged: Judged, threshold: float
) -> dict[str, float]:
    accepted = scores > threshold
    alone = scores >= scores.max(axis=1, keepdims=True)
    used = np.where(accepted.any(axis=1, keepdims=True), accepted, alone)
    errors, weighted = (
        np.asarray(each(map_error, data, judged, jnp.asarray(w, float))) for w in (used, scores)
    )
    ideal = threshold_at(MOST_FALSE, scores, data.right)
    return {
        "tpr": float(accepted[data.right].mean()),
        "fpr": float(accepted[~data.right].mean()),
        "tpr_at": float((scores[data.right] > ideal).mean()),
        "ate_median": _median(errors),
        "ate_mean": float(np.nanmean(errors)),
        "ate_weighted_median": _median(weighted),
        "ate_weighted_mean": float(np.nanmean(weighted)),
        "no_map": float(np.isnan(errors).mean()),
        "no_map_weighted": float(np.isnan(weighted).mean()),
        "threshold": threshold,
    }


def _median(errors: np.ndarray) -> float:
    """The median, in which what has no map counts as worst."""
    return float(np.median(np.where(np.isnan(errors), np.inf, errors)))


def _draw(runs: Sequence[Mapping[str, Any]], out: Path) -> None:
    """True against false positive rates, a band over the seeds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from pcm_jax.plots import plot_threshold_sweep

    curves = {name: [run["curves"][name] for run in runs] for name in runs[0]["curves"]}
    figure, ax = pyplot.subplots(figsize=(7.0, 5.0), layout="constrained")
    labels = {"xlabel": "FPR on held-out worlds", "ylabel": "TPR"}
    plot_threshold_sweep(FALSE_RATES, curves, **labels, percent=True, legend=False, ax=ax)
    ax.legend(fontsize="small", handlelength=3.0)
    ax.set_xscale("log")
    ax.axvline(MOST_FALSE, color="0.4", linestyle=":", linewidth=1.0)
    figure.savefig(out / "rates.png", dpi=100)
    pyplot.close(figure)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("learning", __doc__)
    parser.set_defaults(seeds=[0, 1, 2, 3, 4])
    parser.add_argument("--train", type=int, default=100, help="worlds of each seed to train on")
    parser.add_argument("--test", type=int, default=120, help="held-out worlds of each seed")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
