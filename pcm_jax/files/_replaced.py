"""A folder that is there already, replaced by another at once, or file by file where it cannot be.

Replaced at once is a folder of which nobody would miss more than its files: it holds no folders, it
is not the one that this process works in, no file system begins there, it belongs to the user, and
what our files replace are files, no links. The new folder takes over its mode, the modes of files
of the same names, and by hard links all other files.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from pcm_jax.store import exchange


def can_be_exchanged(folder: Path) -> bool:
    """True for a folder that another may take the place of, as far as can be told beforehand."""
    try:
        if not os.access(folder.parent, os.W_OK) or folder.is_mount():
            return False
        return not (Path.cwd().is_relative_to(folder) or any(map(Path.is_dir, folder.iterdir())))
    except OSError:
        return False


def exchanged(made: Path, folder: Path) -> bool:
    """Puts a folder of finished files in another's place, if that can be done at once.

    Args:
        made: beside `folder`; removed, or what was in `folder`'s place.
        folder: of the name that both are to have.

    Returns:
        False if `folder` is as it was.
    """
    ours = {one.name for one in made.iterdir()}
    try:
        if _owner(made) != _owner(folder):
            return False
        for one in folder.iterdir():
            if one.name not in ours:
                os.link(one, made / one.name, follow_symlinks=False)
            elif one.is_symlink() or not one.is_file():
                return False
            else:
                shutil.copymode(one, made / one.name)
        shutil.copystat(folder, made)
        os.utime(made)
        exchange(made, folder)
    except (OSError, NotImplementedError):
        return False
    _keep_what_came(made, folder, ours)
    return True


def _owner(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_uid, status.st_gid


def _keep_what_came(old: Path, folder: Path, ours: set[str]) -> None:
    """Moves what others wrote to the old folder while it was being replaced to the new one."""
    for one in old.iterdir():
        new = folder / one.name
        if one.name not in ours and not (os.path.lexists(new) and _is_same(one, new)):
            one.replace(new)


def _is_same(one: Path, other: Path) -> bool:
    return os.path.samestat(one.lstat(), other.lstat())
