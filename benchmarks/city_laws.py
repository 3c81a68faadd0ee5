"""How Table I moves with what the paper leaves open: the law of the false closures, covariances.

    python -m benchmarks.city_laws --versions 81 --out DIR

The paper says that 90 closures are random and two groups of 5 aliased, and no more. Here the
methods that select closures run on the same versions under several laws (`cities.Law`), and with
all covariances six times as large: by that much the gates must widen until RANSAC accepts as many
false closures as the paper's does.

Writes summary.json ({law: {method: means over the versions}}), table.md (TPR and FPR of each, and
the translation MSE, m²) and run.json.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import city
from benchmarks.experiments.cities import Law
from benchmarks.experiments.city_report import IN_THE_PAPER
from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.record import Steps, means_by_method
from benchmarks.suite.harness import write_json
from pcm_jax.evaluation import Method, comparison_table

LAWS: dict[str, tuple[Law, float]] = {
    "anywhere in the city": (Law(), 1.0),
    "within 20 m": (Law(random_range=20.0), 1.0),
    "within 5 m": (Law(random_range=5.0), 1.0),
    "5 × aliased noise": (Law(aliased_noise=5.0), 1.0),
    "random claim up to 10 σ": (Law(random_sigma=10.0), 1.0),
    "random claim up to 100 σ": (Law(random_sigma=100.0), 1.0),
    "6 × covariances": (Law(), 6.0),
    "within 5 m, 6 × covariances": (Law(random_range=5.0), 6.0),
}
"""Law of the false closures, and the factor of all covariances."""

METHODS = {name: city.PAPER[name] for name in ("pcm-exact-11", "ransac-1", "ransac-3.5", "scgp")}
METHODS["scgp-linear"] = Method("scgp", 0.11, (("affinity", "linear"),))
METHODS["scgp-binary"] = city.BINARY["scgp-binary"]
METHODS["pcm-exact-99"] = city.CALIBRATED["pcm-exact-99"]
COMPARISON = city.Comparison(METHODS)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command_parser("city_laws", __doc__)
    city.add_city_options(parser)
    options = parser.parse_args(arguments)
    start, here = time.perf_counter(), city.source_of(parser, options)
    options.out.mkdir(parents=True, exist_ok=True)
    tasks = {
        f"{k}-{seed}-{number:04}": partial(city.run_version, source, COMPARISON, seed, number)
        for k, source in enumerate(_under_all_laws(here))
        for seed in options.seeds
        for number in range(options.versions)
    }
    stamp = here, LAWS, COMPARISON
    steps = Steps(options.out / "steps", stamp, [*city.sources(), Path(__file__)])
    results = run_tasks("versions under all laws", tasks, steps, jobs=options.jobs)
    summary = {
        law: means_by_method(run for name, run in results.items() if name.startswith(f"{k}-"))
        for k, law in enumerate(LAWS)
    }
    write_json(options.out / "summary.json", summary)
    (options.out / "table.md").write_text(f"{table(summary)}\n\n{options.versions} versions\n")
    write_run(options.out, options, start)
    print(f"{table(summary)}\nwrote {options.out / 'summary.json'}")
    return 0


def _under_all_laws(here: city.Source) -> list[city.Source]:
    return [here._replace(law=law, weaker=weaker) for law, weaker in LAWS.values()]


def table(summary: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """A row for each law, first the paper's; in each cell TPR / FPR / translation MSE in m²."""
    rows: dict[str, dict[str, Any]] = {"the paper": _cells(IN_THE_PAPER)}
    rows |= {law: _cells(of_law) for law, of_law in summary.items()}
    return comparison_table(rows, list(METHODS))


def _cells(rows: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    return {
        name: f"{row['tpr']:.3f} / {row['fpr']:.4f} / {row['translation_mse']:.3g}"
        for name, row in rows.items()
        if name in METHODS
    }


if __name__ == "__main__":
    raise SystemExit(main())
