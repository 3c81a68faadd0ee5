"""Packages that the tests are installed with, by version and hash of the file they came in.

    PIP_REPORT=installed.json pip install -e '.[dev]'
    python tests/supply.py installed.json > tests/installed.txt

`tests/installed.txt` is the record. Under `PIP_REPORT` the head of a test run says which packages
are others than those; a file of a recorded version with another hash is said first. The record is a
requirements file as well: `pip install --require-hashes -r tests/installed.txt` takes no others.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path

RECORD = Path(__file__).with_name("installed.txt")
LINE = re.compile(r"(?P<name>\S+)==(?P<version>\S+) --hash=sha256:(?P<hash>[0-9a-f]{64})")
Packages = dict[str, tuple[str, str]]


def installed(report: str) -> Packages:
    """Version and SHA-256 by package, of what pip reports; without what came in no file."""
    found = {}
    for one in json.loads(report)["install"]:
        digest = one["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        if digest:
            name = re.sub(r"[-_.]+", "-", one["metadata"]["name"]).lower()
            found[name] = one["metadata"]["version"], digest
    return found


def as_lines(packages: Packages) -> list[str]:
    """Writes packages as requirements with hashes, by name."""
    return [
        f"{name}=={version} --hash=sha256:{digest}"
        for name, (version, digest) in sorted(packages.items())
    ]


def recorded(lines: Iterable[str]) -> Packages:
    """Reads requirements with hashes."""
    matches = [LINE.fullmatch(line.strip()) for line in lines]
    return {m["name"]: (m["version"], m["hash"]) for m in matches if m}


def differences(found: Packages, known: Packages) -> list[str]:
    """Says what is installed otherwise than recorded: other files of one version, then the rest."""
    same_version = {n for n, (version, _) in found.items() if known.get(n, ("",))[0] == version}
    other = {name for name in found if found[name] != known.get(name)}
    return [
        *(f"{name} {found[name][0]}: another file" for name in sorted(other & same_version)),
        *(
            f"{name} {found[name][0]} ({known[name][0] if name in known else 'not'} recorded)"
            for name in sorted(other - same_version)
        ),
    ]


def header() -> list[str]:
    """The lines at the head of a test run; none without a report of pip's."""
    report = Path(os.environ.get("PIP_REPORT", ""))
    if not report.is_file():
        return []
    found = installed(report.read_text())
    told = differences(found, recorded(RECORD.read_text().splitlines()))
    same = len(found) - len(told)
    return [f"installed: {same} packages as recorded in tests/installed.txt", *told]


if __name__ == "__main__":
    sys.stdout.write("\n".join(as_lines(installed(Path(sys.argv[1]).read_text()))) + "\n")
