"""Credentials do not belong into the URL of a recording: messages show it and the database keeps it."""

from __future__ import annotations

import re

from semdb.errors import UsageError

# A URL of its own or within another (``zip://a.zip::sftp://...``); of a path, Python leaves one of the two slashes.
_AUTHORITY = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]*):(?P<slashes>/{1,2})(?=(?P<authority>[^/?#]+))", re.IGNORECASE)
_NO_PASSWORDS = {"github", "gist", "git"}  # organisation:repository@revision
_PORT = re.compile(r"[0-9]*")


def refuse_credentials(address: str) -> None:
    """Raises UsageError, which does not show `address`, where it holds a password or the token of a web server."""
    for found in _AUTHORITY.finditer(address):
        scheme = found["scheme"].lower()
        if scheme not in _NO_PASSWORDS and _has_secret(scheme, found["authority"], is_path=found["slashes"] == "/"):
            raise UsageError(
                f"a URL {scheme}://... of a recording holds a password, which messages would show and the database "
                "keep: leave it out, and give it to fsspec in its configuration (~/.config/fsspec/*.json) or its "
                f"environment variables (as FSSPEC_{scheme.upper()}_PASSWORD: the name of the file system's argument)"
            )


def _has_secret(scheme: str, authority: str, *, is_path: bool) -> bool:
    user, at, _ = authority.rpartition("@")
    if at:
        return ":" in user or scheme in ("http", "https")
    # A password with a / that is not escaped reads as a host and a port.
    host, colon, port = authority.rpartition(":")
    return not is_path and bool(host and colon) and "]" not in port and _PORT.fullmatch(port) is None
