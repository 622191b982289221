"""TLS to a server as its URL asks for it, with the names and meanings of MySQL's own clients."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Any

from sqlalchemy import URL

from semdb.errors import UsageError

TLS_KEYS = frozenset({"ssl_mode", "ssl_ca", "ssl_cert", "ssl_key"})
MODES = ("DISABLED", "PREFERRED", "REQUIRED", "VERIFY_CA", "VERIFY_IDENTITY")


def tls_arguments(url: URL) -> dict[str, Any]:
    """The driver's arguments for the parameters ``ssl_*`` of `url`.

    PREFERRED, the default, takes TLS when the server has it and does not check whose certificate it is; with
    ``ssl_ca`` the default is VERIFY_IDENTITY. Raises UsageError for what makes no sense, or a file that is not there.
    """
    given = {key: str(url.query[key]) for key in TLS_KEYS if key in url.query}
    mode = given.get("ssl_mode", "VERIFY_IDENTITY" if "ssl_ca" in given else "PREFERRED").upper()
    if mode not in MODES:
        raise UsageError(f"ssl_mode={mode} in the database URL: it is one of {', '.join(MODES)}")
    for key in ("ssl_ca", "ssl_cert", "ssl_key"):
        if key in given and not Path(given[key]).is_file():
            raise UsageError(f"{key}={given[key]} in the database URL: there is no such file")
    if mode == "DISABLED":
        return {"ssl_disabled": True}
    if mode == "PREFERRED" and not given.keys() & {"ssl_cert", "ssl_key"}:
        return {}
    if mode.startswith("VERIFY") and "ssl_ca" not in given:
        raise UsageError(f"ssl_mode={mode} in the database URL needs ssl_ca=FILE, the certificate to trust")
    return {"ssl": _context(mode, given)}


def _context(mode: str, given: dict[str, str]) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=given.get("ssl_ca"))
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT  # servers' own certificates lack what it asks for
        context.check_hostname = mode == "VERIFY_IDENTITY"
        if not mode.startswith("VERIFY"):
            context.verify_mode = ssl.CERT_NONE
        if "ssl_cert" in given:
            context.load_cert_chain(given["ssl_cert"], given.get("ssl_key"))
    except (ssl.SSLError, OSError) as error:
        raise UsageError(f"the TLS files of the database URL cannot be used: {error}") from error
    return context
