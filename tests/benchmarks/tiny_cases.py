"""Cases that take no time, for the harness's tests; other processes import this module."""

import functools
import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.suite.harness import (
    ENVIRONMENT,
    Case,
    Measured,
    Metric,
    NotMeasuredError,
    Settings,
    run,
)

LOG = "log"
KILLED = "killed"


def logged(name, settings):
    """Notes in the data folder that it ran."""
    with (settings.data / LOG).open("a") as log:
        log.write(f"{name}\n")
    return {"seconds": Measured(0.25, f"case {name}"), "digits": Measured(3.0)}


def killing(settings):
    """Kills the process that started it, the first time."""
    if not (settings.data / KILLED).exists():
        (settings.data / KILLED).touch()
        os.kill(os.getppid(), signal.SIGKILL)
    return logged("killing", settings)


def absent(settings):
    raise NotMeasuredError("no such data")


def environment(settings):
    """1 if every setting of the harness is there."""
    present = ENVIRONMENT.items() <= os.environ.items()
    return {"seconds": Measured(float(present)), "digits": Measured(None)}


def broken(settings):
    raise ValueError("a fault")


def dying(settings):
    os._exit(3)


METRICS = (Metric("seconds", "s", figure=0.5), Metric("digits", "", "target", (1.0, 2.0)))


def case(name, measure=None, **options):
    return Case(f"tiny/{name}", METRICS, measure or functools.partial(logged, name), **options)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    run([case("first"), case("killing", killing), case("last")], Settings(True, folder), folder)
