"""Table I under other laws and numbers of false closures, which the paper leaves open.

    python -m benchmarks.city_laws --versions 81 --out DIR
    python -m benchmarks.city_laws --study shares --information sqrt --versions 20 --out DIR

The paper says that 90 closures are random and two groups of 5 aliased, and no more. *Laws*: the
methods that select closures, on the same versions under several laws (`cities.Law`), and with all
covariances six times as large: by that much the gates must widen until RANSAC accepts as many false
closures as the paper's does. *Shares*: GNC beside PCM, with fewer and fewer random closures.

Writes summary.json ({law: {method: means over the versions}}), table.md (TPR and FPR of each, and
the translation MSE, m²) and run.json.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks import city
from benchmarks.experiments.city_report import IN_THE_PAPER
from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.record import means_by_method
from pcm_jax.evaluation import comparison_table
from pcm_jax.experiments import Method
from pcm_jax.experiments.cities import Law
from pcm_jax.store import Store, digest, write_json


class Study(NamedTuple):
    """The laws that are varied, and the methods that have to stand it.

    Attributes:
        laws: of the false closures, and the factor of all covariances.
        methods: rows of Table I.
    """

    laws: Mapping[str, tuple[Law, float]]
    methods: Mapping[str, Method]


def _rows(*names: str) -> dict[str, Method]:
    return {name: city.ROWS["all"][name] for name in names}


STUDIES = {
    "laws": Study(
        {
            "anywhere in the city": (Law(), 1.0),
            "within 20 m": (Law(random_range=20.0), 1.0),
            "within 5 m": (Law(random_range=5.0), 1.0),
            "5 × aliased noise": (Law(aliased_noise=5.0), 1.0),
            "random claim up to 10 σ": (Law(random_sigma=10.0), 1.0),
            "random claim up to 100 σ": (Law(random_sigma=100.0), 1.0),
            "6 × covariances": (Law(), 6.0),
            "within 5 m, 6 × covariances": (Law(random_range=5.0), 6.0),
        },
        {
            **_rows("pcm-exact-11", "ransac-1", "ransac-3.5", "scgp", "scgp-binary"),
            "scgp-linear": Method("scgp", 0.11, (("affinity", "linear"),)),
            **_rows("pcm-exact-99"),
        },
    ),
    "shares": Study(
        {
            f"{(10 + random) / (25 + random):.0%} false": (Law(random=random), 1.0)
            for random in (5, 25, 50, 90)
        },
        _rows("gnc", "pcm-exact-99"),
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command_parser("city_laws", __doc__)
    city.add_city_options(parser)
    parser.add_argument("--study", choices=tuple(STUDIES), default="laws", help="what to vary")
    options = parser.parse_args(arguments)
    start, here = time.perf_counter(), city.source_of(parser, options)
    options.out.mkdir(parents=True, exist_ok=True)
    study = STUDIES[options.study]
    comparison = city.Comparison(study.methods)
    tasks = {
        f"{k}-{seed}-{number:04}": partial(city.run_version, source, comparison, seed, number)
        for k, source in enumerate(_under_all_laws(here, study))
        for seed in options.seeds
        for number in range(options.versions)
    }
    stamp = digest(here, study, files=[*city.sources(), Path(__file__)])
    steps = Store(options.out / "steps", stamp)
    results = run_tasks(f"versions under all {options.study}", tasks, steps, jobs=options.jobs)
    summary = {
        law: means_by_method(run for name, run in results.items() if name.startswith(f"{k}-"))
        for k, law in enumerate(study.laws)
    }
    write_json(options.out / "summary.json", summary)
    (options.out / "table.md").write_text(f"{table(summary)}\n\n{options.versions} versions\n")
    write_run(options.out, options, start)
    print(f"{table(summary)}\nwrote {options.out / 'summary.json'}")
    return 0


def _under_all_laws(here: city.Source, study: Study) -> list[city.Source]:
    return [here._replace(law=law, weaker=weaker) for law, weaker in study.laws.values()]


def table(summary: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """A row for each law, and the paper's; in each cell TPR / FPR / translation MSE in m²."""
    methods = list(next(iter(summary.values())))
    theirs = {name: row for name, row in IN_THE_PAPER.items() if name in methods}
    rows = {"the paper": _cells(theirs)} if theirs else {}
    rows |= {law: _cells(of_law) for law, of_law in summary.items()}
    return comparison_table(rows, methods)


def _cells(rows: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    return {
        name: f"{row['tpr']:.3f} / {row['fpr']:.4f} / {row['translation_mse']:.3g}"
        for name, row in rows.items()
    }


if __name__ == "__main__":
    raise SystemExit(main())
