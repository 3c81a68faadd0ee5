"""Compiled programs kept on disk between commands, so that the second is quick at once.

JAX's own cache, in the user's cache folder: `PCM_JAX_CACHE` names another one, or is "off". What
the user has set for JAX himself stays. Nothing depends on it: a folder that cannot be made or
pruned is done without. As a library the package sets nothing: see JAX's
`jax_compilation_cache_dir`.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

VARIABLE = "PCM_JAX_CACHE"
OFF = "off"
MOST_BYTES = 256 << 20
WORTH_KEEPING = 0.5
"""Seconds of compilation."""
OF_JAX = "JAX_COMPILATION_CACHE_DIR"


def keep_compiled() -> None:
    """Tells JAX, before it is imported, where compiled programs are kept; prunes what is there."""
    asked = os.environ.get(VARIABLE, "")
    if asked == OFF or OF_JAX in os.environ or "jax" in sys.modules:
        return
    folder = Path(asked) if asked else user_cache() / "pcm-jax" / "compiled"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        prune(folder, MOST_BYTES)
        os.environ[OF_JAX] = str(folder)
        least = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
        os.environ.setdefault(least, str(WORTH_KEEPING))


def user_cache() -> Path:
    """The user's folder for what can be made again, by the custom of the platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def prune(folder: Path, most: int) -> None:
    """Removes the files written longest ago until no more than so many bytes are left."""
    files = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
    left = sum(state.st_size for _, state in files)
    for path, state in sorted(files, key=lambda file: file[1].st_mtime):
        if left <= most:
            break
        path.unlink(missing_ok=True)
        left -= state.st_size
