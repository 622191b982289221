"""`semdb serve`: the database over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semdb.cli.options import Overrides, settings_options


@settings_options(models=True)
def command(
    overrides: Overrides,
    host: Annotated[
        str | None, typer.Option("--host", metavar="H", help="Address to listen at; default 127.0.0.1.")
    ] = None,
    port: Annotated[int | None, typer.Option("--port", metavar="P", help="Port; default 8765.")] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", help="Processes, each with networks and index of its own.")
    ] = None,
    tls_certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="FILE", help="Certificate chain for HTTPS, PEM.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help="Its key, PEM.")] = None,
    ingest_roots: Annotated[
        str | None,
        typer.Option("--ingest-roots", metavar="FOLDERS", help="Folders of recordings to ingest, by colons."),
    ] = None,
) -> None:
    """Serve the database to robots and programs over HTTP, until it is stopped.

    Without a token (`semdb token create`) only programs of the same machine are served. Needs the extra `serve`.
    """
    from semdb.errors import UsageError
    from semdb.service.settings import serve_settings

    settings = overrides.settings()
    given = {
        "host": host,
        "port": port,
        "workers": workers,
        "tls_certificate": tls_certificate,
        "tls_key": tls_key,
        "ingest_roots": ingest_roots,
    }
    serve = serve_settings({name: value for name, value in given.items() if value is not None})
    try:
        from semdb.service.run import serve_forever
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "semdb":
            raise
        missing = f"semdb serve needs the serve extra ({error.name} is missing): pip install 'semdb[serve]'"
        raise UsageError(missing) from None
    serve_forever(settings, serve)
