"""Running something in a process of another account, which rights of files hold for (root may do anything)."""

from __future__ import annotations

import multiprocessing
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

NOBODY = 65534


def as_somebody_else(function: Callable[[], Any], user: int = NOBODY) -> Any:
    """What `function` returns in a forked process of `user`; fails with its traceback where it raises.

    All that it imports must have been imported before: `user` may not reach the interpreter's files. Skips where this
    process may not become another user.
    """
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    def run() -> None:
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
        try:
            there.send((True, function()))
        except BaseException:
            there.send((False, traceback.format_exc()))

    process = context.Process(target=run)
    process.start()
    there.close()
    try:
        fine, found = here.recv()
    except EOFError:
        process.join()
        pytest.fail(f"the process ended with {process.exitcode}")
    process.join(30)
    if not fine:
        pytest.fail(found)
    return found


def give(user: int, *paths: Path) -> None:
    """Makes files those of `user`."""
    for path in paths:
        os.chown(path, user, user)
