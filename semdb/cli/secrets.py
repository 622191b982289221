"""Keeping passwords of the command line out of the list of processes."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

# From the first colon to the last @, whatever is between: too much is hidden rather than too little.
_PASSWORD = re.compile(rb"[\w+]+://[^:]*?:(?P<password>.*)@", re.DOTALL)


def hide_password(url: str) -> None:
    """Overwrites the password of `url` where the kernel shows this process' arguments to everybody on the machine.

    Linux only; elsewhere, or where the kernel does not tell the place, nothing happens: SEMDB_DATABASE_URL is the
    better way. Between the start of the process and this call it can be seen.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end: fields 48 and 49 of proc(5)
        arguments = Path("/proc/self/cmdline").read_bytes()
    except (OSError, ValueError, IndexError):
        return
    if not 0 < start < end or len(arguments) > end - start:
        return
    for first, last in password_places(arguments, url):
        ctypes.memset(start + first, ord("*"), last - first)


def password_places(arguments: bytes, url: str) -> Iterator[tuple[int, int]]:
    """Where the password of `url` is in `arguments`: first byte, and the one after the last."""
    written = os.fsencode(url)  # as it was before Python made text of it
    found = None if written.startswith(b"sqlite") else _PASSWORD.match(written)
    if found is None:
        return
    position = arguments.find(written)
    while position >= 0:
        yield position + found.start("password"), position + found.end("password")
        position = arguments.find(written, position + 1)
