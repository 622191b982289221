"""Keeping passwords of the command line out of the list of processes."""

from __future__ import annotations

import ctypes
import re
import sys
from pathlib import Path

_PASSWORD = re.compile(r"^[\w+]+://[^:@/]*:(?P<password>[^@/]*)@")


def hide_password(url: str) -> None:
    """Overwrites the password of `url` where the kernel shows this process' arguments to everybody on the machine.

    Linux only; elsewhere, or where the kernel does not tell the place, nothing happens: SEMDB_DATABASE_URL is the
    better way. Between the start of the process and this call it can be seen.
    """
    found = _PASSWORD.match(url)
    if found is None or not found["password"] or not sys.platform.startswith("linux"):
        return
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end: fields 48 and 49 of proc(5)
        arguments = Path("/proc/self/cmdline").read_bytes()
    except (OSError, ValueError, IndexError):
        return
    if not 0 < start < end or len(arguments) > end - start:
        return
    secret = found["password"].encode()
    position = arguments.find(url.encode())
    if position >= 0:
        place = start + position + found.start("password")
        ctypes.memset(place, ord("*"), len(secret))
