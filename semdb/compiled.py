"""`kernel`: numba as semdb uses it, nogil and cached on disk, uncached where no folder can be written."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, TypeVar, overload

import numba

logger = logging.getLogger(__name__)

# errors as in numpy: a test for division by zero in a loop would keep it from being vectorised
_OPTIONS = {"nogil": True, "error_model": "numpy"}

_Function = TypeVar("_Function", bound=Callable[..., Any])


@overload
def kernel(function: _Function, /) -> _Function: ...


@overload
def kernel(**options: object) -> Callable[[_Function], _Function]: ...


def kernel(function: Callable[..., Any] | None = None, /, **options: object) -> Any:
    """Decorator: compile a function at its first call, without the GIL.

    The result is cached beside the source, in ``NUMBA_CACHE_DIR`` or in the user's cache; where none can be written a
    warning is logged once per process and every process compiles anew. `options` are numba's (``fastmath``).
    """
    if function is None:
        return lambda decorated: kernel_of(decorated, options)
    return kernel_of(function, options)


def kernel_of(function: _Function, options: Mapping[str, object]) -> _Function:
    """`function` compiled with the options of all kernels and these."""
    _check_named_folder(numba.config.CACHE_DIR)
    try:
        return numba.njit(function, cache=True, **_OPTIONS, **options)  # type: ignore[no-any-return]
    except RuntimeError as error:  # numba found no folder that it may write
        if "cannot cache" not in str(error):
            raise
        _warn_uncached()
        return numba.njit(function, **_OPTIONS, **options)  # type: ignore[no-any-return]


@lru_cache(maxsize=8)
def _check_named_folder(folder: str) -> None:
    if not folder:
        return
    try:
        os.makedirs(folder, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        logger.warning("NUMBA_CACHE_DIR=%s cannot be written; compiled kernels go to numba's default folder", folder)


@lru_cache(maxsize=1)
def _warn_uncached() -> None:
    logger.warning(
        "compiled kernels cannot be kept: neither the folder of the package nor the user's cache can be written. "
        "Every process compiles them anew, about 10 s; set NUMBA_CACHE_DIR to a folder that can be written"
    )
