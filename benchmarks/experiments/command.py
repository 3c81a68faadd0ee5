"""Options, processes and the record of a run, common to the commands of all experiments."""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.experiments.record import Progress
from benchmarks.suite.measure import machine
from pcm_jax.evaluation import comparison_table
from pcm_jax.store import Store, write_json

Task = Callable[[], dict[str, Any]]


def command_parser(experiment: str, doc: str | None) -> argparse.ArgumentParser:
    """A parser with the options that every experiment has: --seeds, --jobs, --out.

    Args:
        experiment: the module's name below `benchmarks`.
        doc: the module's docstring; its first line describes the command.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{experiment}",
        description=(doc or "").partition("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--seeds", "--seed", type=int, nargs="+", default=[0], metavar="N", help="of the simulation"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    parser.add_argument("--out", type=Path, required=True, help="folder for results; resumes there")
    return parser


def run_tasks(
    what: str, tasks: Mapping[str, Task], steps: Store, *, jobs: int = 1
) -> dict[str, dict[str, Any]]:
    """Results of all tasks by name, each kept on disk as soon as it is there.

    Args:
        what: the tasks are, for the line that shows progress.
        tasks: to be computed where none is kept; with several jobs they are pickled.
        steps: where results are kept.
        jobs: processes; one computes in this process.
    """
    results = {name: steps.read(name) for name in tasks}
    missing = [name for name, result in results.items() if result is None]
    tell, done = Progress(what, len(tasks)), len(tasks) - len(missing)
    tell(done)
    for name, result in _computed({name: tasks[name] for name in missing}, jobs):
        results[name] = steps.write(name, result)
        done += 1
        tell(done)
    return {name: result for name, result in results.items() if result is not None}


def _computed(tasks: Mapping[str, Task], jobs: int) -> Any:
    """Names and results as they come."""
    if jobs <= 1 or len(tasks) <= 1:
        yield from ((name, task()) for name, task in tasks.items())
        return
    # A process that is forked would share the threads of JAX's runtime, which do not survive it.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(task): name for name, task in tasks.items()}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def finish(
    options: argparse.Namespace,
    start: float,
    summary: Any,
    rows: Mapping[str, Mapping[str, Any]],
    columns: Mapping[str, str],
) -> int:
    """Writes summary.json, table.md and run.json, prints the table; the exit status.

    Args:
        options: of `command_parser`.
        start: of the command, `time.perf_counter`.
        summary: of the results.
        rows, columns: of the table, see `comparison_table`; a column that no row has is left out.
    """
    known = {name for row in rows.values() for name in row}
    table = comparison_table(rows, {name: columns[name] for name in columns if name in known})
    write_json(options.out / "summary.json", summary)
    (options.out / "table.md").write_text(table + "\n")
    write_run(options.out, options, start)
    print(table)
    return 0


def write_run(out: Path, options: argparse.Namespace, start: float, **more: Any) -> None:
    """run.json: options, machine, the seconds since `start` (`time.perf_counter`), and `more`."""
    given = {name: _plain(value) for name, value in vars(options).items() if name != "out"}
    entry = {
        "options": given,
        "seconds": round(time.perf_counter() - start, 1),
        **more,
        "machine": machine(),
    }
    write_json(out / "run.json", entry)


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return value.name  # where data lies on this machine is nobody's business
    if isinstance(value, slice):
        return f"{value.start or 0}:{'' if value.stop is None else value.stop}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    return value
