"""One process of a test run compiles a kernel; the others wait for it, and load what it left.

In a fresh clone nothing is compiled yet, and processes that begin at once would all compile the same.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

_PACKAGE = "semdb."


def one_at_a_time() -> None:
    """From now on this process, and those that it forks, wait where another one compiles the same function."""
    compiling = Dispatcher.compile
    folder = Path(tempfile.gettempdir()) / f"semdb-tests-compiling-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)

    def compile_alone(self: Any, signature: Any) -> Any:
        function = self.py_func
        if not function.__module__.startswith(_PACKAGE):
            return compiling(self, signature)
        name = f"{function.__code__.co_filename}:{function.__qualname__}"
        # numba's own lock first, as for kernels that are compiled within others: else two threads could wait crosswise
        with global_compiler_lock, open(folder / hashlib.sha256(name.encode()).hexdigest()[:16], "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return compiling(self, signature)

    Dispatcher.compile = compile_alone
