"""`kernel`: numba as semdb uses it, nogil and cached on disk, uncached where no folder can be written or trusted."""

from __future__ import annotations

import inspect
import logging
import os
import threading
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba

from semdb.rights import file_problem, folder_problem

logger = logging.getLogger(__name__)

# errors as in numpy: a test for division by zero in a loop would keep it from being vectorised
_OPTIONS = {"nogil": True, "error_model": "numpy"}
_configuration = threading.Lock()  # of numba, while it is changed

_Function = TypeVar("_Function", bound=Callable[..., Any])


@overload
def kernel(function: _Function, /) -> _Function: ...


@overload
def kernel(**options: object) -> Callable[[_Function], _Function]: ...


def kernel(function: Callable[..., Any] | None = None, /, **options: object) -> Any:
    """Decorator: compile a function at its first call, without the GIL.

    The result is cached beside the source, in ``NUMBA_CACHE_DIR`` or in the user's cache; where none can be written, or
    others may write there, a warning is logged once per process and every process compiles anew. `options` are
    numba's (``fastmath``).
    """
    if function is None:
        return lambda decorated: kernel_of(decorated, options)
    return kernel_of(function, options)


def kernel_of(function: _Function, options: Mapping[str, object]) -> _Function:
    """`function` compiled with the options of all kernels and these."""
    _check_named_folder(numba.config.CACHE_DIR)
    for named in dict.fromkeys((numba.config.CACHE_DIR, "")):  # and numba's own folders where that one is not trusted
        cached = _cached(function, options, named)
        if cached is not None:
            return cached
    return numba.njit(function, **_OPTIONS, **options)  # type: ignore[no-any-return]


def _cached(function: _Function, options: Mapping[str, object], named: str) -> _Function | None:
    """`function` with a cache in the folder `named`, or in numba's own for ""; None where it has none to be trusted."""
    with _configuration:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = named
        try:
            compiled = numba.njit(function, cache=True, **_OPTIONS, **options)
        except RuntimeError as error:  # numba found no folder that it may write
            if "cannot cache" not in str(error):
                raise
            _warn_uncached()
            return None
        finally:
            numba.config.CACHE_DIR = before
    problem = cache_problem(Path(compiled._cache.cache_path), Path(inspect.getfile(function)))
    if problem is None:
        return compiled  # type: ignore[no-any-return]
    _warn_untrusted(problem)
    return None


@lru_cache(maxsize=64)
def cache_problem(folder: Path, source: Path) -> str | None:
    """Why compiled kernels in `folder`, of functions in the file `source`, are not to be trusted; None where they are.

    They are pickles, so who may write them runs code here. Whoever owns `source` does so anyway, and so does everyone
    who may write beside it.
    """
    try:
        owners = [os.stat(source).st_uid]
    except OSError:
        owners = []
    beside = folder.name == "__pycache__" and folder.parent == source.parent
    if beside and folder_problem(source.parent, owners) is not None:
        return None
    problem = folder_problem(folder, owners)
    if problem is not None:
        return problem
    try:
        files = [Path(entry.path) for entry in os.scandir(folder) if entry.name.endswith((".nbi", ".nbc"))]
    except OSError as error:
        return f"{folder} cannot be listed ({error.strerror})"
    return next((found for file in files if (found := file_problem(file, owners)) is not None), None)


@lru_cache(maxsize=8)
def _check_named_folder(folder: str) -> None:
    if not folder:
        return
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        logger.warning("NUMBA_CACHE_DIR=%s cannot be written; compiled kernels go to numba's default folder", folder)


@lru_cache(maxsize=64)
def _warn_untrusted(problem: str) -> None:
    logger.warning(
        "compiled kernels are not read from a cache that others may have written, because they run as code: %s. Take "
        "the rights away (chmod go-w), or set NUMBA_CACHE_DIR to a folder of your own",
        problem,
    )


@lru_cache(maxsize=1)
def _warn_uncached() -> None:
    logger.warning(
        "compiled kernels cannot be kept: neither the folder of the package nor the user's cache can be written. "
        "Every process compiles them anew, about 10 s; set NUMBA_CACHE_DIR to a folder that can be written"
    )
