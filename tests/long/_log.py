"""What every log says of its run: commit, machine, seconds."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOGS = Path(__file__).resolve().parent / "logs"


def commit() -> str:
    """The commit that the working tree is at, and whether it differs from it."""
    told = [
        subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=False)
        for command in (
            ["rev-parse", "--short", "HEAD"],
            ["status", "--porcelain", "pcm_jax", "tests", ":!tests/long/logs"],
        )
    ]
    return told[0].stdout.strip() + (" and changes" if told[1].stdout.strip() else "")


def machine() -> str:
    """Processor, cores, Python."""
    return f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def table(head: list[str], rows: list[list[object]]) -> str:
    """A table in markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines) + "\n"


def found_in(lines: list[str]) -> str:
    """The last part of a log: what was found, a line each."""
    return "\n## Found\n\n" + ("\n".join(f"- {one}" for one in lines) or "nothing") + "\n"
