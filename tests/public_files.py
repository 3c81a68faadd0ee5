"""Says which of the public files that tests and benchmarks read are missing, or are other ones.

    python tests/public_files.py [FOLDER]        # by default ../shared/data, beside the checkout

None of them is ours to ship. `public_files.tsv` says where each comes from: the repository on
GitHub, the path in it, the commit, and the SHA-256 digest of its bytes. Save them under the names
in the first column; those that end in `.xz` are compressed so (`xz FILE`), and the digest is that
of the bytes before. Tests that read a file which is not there are skipped.
"""

from __future__ import annotations

import csv
import hashlib
import lzma
import sys
from collections.abc import Iterator
from pathlib import Path

MANIFEST = Path(__file__).with_suffix(".tsv")
FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data"


def rows(manifest: Path = MANIFEST) -> list[dict[str, str]]:
    """The manifest's rows by column."""
    with manifest.open(newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def faults(folder: Path, manifest: Path = MANIFEST) -> Iterator[str]:
    """One line for each file that is missing or differs, with where to get it."""
    for row in rows(manifest):
        found = _digest(folder / row["file"])
        if found != row["sha256"]:
            what = f"differs ({found[:12]})" if found else "missing"
            origin = "/".join(("github.com", row["repo"], "raw", row["commit"], row["path"]))
            yield f"{row['file']}: {what}; {origin}"


def _digest(path: Path) -> str | None:
    """The digest of a file's bytes, uncompressed; None if it is missing."""
    if not path.exists():
        return None
    content = path.read_bytes()
    try:
        content = lzma.decompress(content) if path.suffix == ".xz" else content
    except lzma.LZMAError:
        return "no xz file"
    return hashlib.sha256(content).hexdigest()


def main(arguments: list[str]) -> int:
    """Lists the faults; 1 if there is any."""
    folder = Path(arguments[0]) if arguments else FOLDER
    found = list(faults(folder))
    lines = [*found, f"{len(rows()) - len(found)} of {len(rows())} files are in {folder}"]
    sys.stdout.write("\n".join(lines) + "\n")
    return int(bool(found))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
