"""Who else may write where files lie that are run when they are read, checked as ssh checks its keys.

Compiled kernels are pickles: whoever may write one, or exchange a folder above it, runs code as the user that reads it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Collection
from functools import lru_cache
from pathlib import Path


def folder_problem(folder: Path, owners: Collection[int] = ()) -> str | None:
    """Why another user could put files into `folder`, or another folder into its place; None where nobody can.

    Trusted are root, the user of this process, and `owners` (user ids). A folder above may be open to all where it is
    sticky, as ``/tmp`` is: nobody can exchange what others own there. Links on the way are followed and checked.
    """
    trusted = frozenset({0, os.geteuid(), *owners})
    for way in _ways(folder):
        for path in way:
            try:
                link, found = os.lstat(path), os.stat(path)
            except OSError as error:
                return f"{path} cannot be looked at ({error.strerror})"
            for item in (link, found):
                if item.st_uid not in trusted:
                    return f"{path} belongs to {user_name(item.st_uid)}"
            sticky = bool(found.st_mode & stat.S_ISVTX) and path != way[-1]
            if is_open(found) and not sticky:
                return f"{path} may be written by others (mode {stat.S_IMODE(found.st_mode):04o})"
    return None


def file_problem(file: Path, owners: Collection[int] = ()) -> str | None:
    """Why another user may have written, or could write, a `file` in a folder that is trusted; None where none can."""
    try:
        found = os.lstat(file)
    except OSError:
        return None  # gone meanwhile
    if not stat.S_ISREG(found.st_mode):
        return f"{file} is no regular file"
    if found.st_uid not in {0, os.geteuid(), *owners}:
        return f"{file} belongs to {user_name(found.st_uid)}"
    if is_open(found):
        return f"{file} may be written by others (mode {stat.S_IMODE(found.st_mode):04o})"
    return None


def is_open(found: os.stat_result) -> bool:
    """Whether users other than its owner may write it. A group of the user's own, without members, is nobody else."""
    if found.st_mode & stat.S_IWOTH:
        return True
    return bool(found.st_mode & stat.S_IWGRP) and not _is_own_group(found.st_gid)


def user_name(uid: int) -> str:
    """The name of a user, or the number where it has none."""
    import pwd

    try:
        return f"user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"user {uid}"


def _ways(folder: Path) -> list[list[Path]]:
    """From the root down to `folder`: by the names that lead to it, and without links."""
    ends = dict.fromkeys((Path(os.path.abspath(folder)), Path(os.path.realpath(folder))))
    return [[*reversed(end.parents), end] for end in ends]


@lru_cache(maxsize=64)
def _is_own_group(gid: int) -> bool:
    import grp
    import pwd

    try:
        me, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    private = gid == 0 or (gid == me.pw_gid and group.gr_name == me.pw_name)
    return private and set(group.gr_mem) <= {me.pw_name, "root"}
