"""Starting the service: as one process, or as several that share an address."""

from __future__ import annotations

import logging
import os
import secrets
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from starlette.types import ASGIApp

from semdb.api import Database
from semdb.errors import SemdbError, UsageError
from semdb.events import PlainFormatter, event, log_to
from semdb.service.app import make_app
from semdb.service.metrics import MULTIPROCESS
from semdb.service.patient import PatientProtocol
from semdb.service.settings import ServeSettings
from semdb.service.state import Service, note
from semdb.settings import Settings

GRACE = 5


def open_service(settings: Settings, serve: ServeSettings) -> Service:
    """A service on the database of the settings; statements have the service's time limit. Raises SemdbError."""
    limit = min(settings.sql_time_limit_s, serve.sql_time_limit_s)
    database = Database(settings.model_copy(update={"sql_time_limit_s": limit}), say=_say)
    database.check()
    return Service(database, serve)


def _say(line: str) -> None:
    note(line)
    event("assumed", level=logging.DEBUG, what=line)


def check(settings: Settings, serve: ServeSettings) -> None:
    """Raises UsageError, SemdbError for what would not be served, or not safely."""
    if (serve.tls_certificate is None) != (serve.tls_key is None):
        raise UsageError("HTTPS needs both --tls-certificate and --tls-key")
    for path in filter(None, (serve.tls_certificate, serve.tls_key)):
        if not path.is_file():
            raise UsageError(f"{path}: there is no such file")
    with Database(settings, say=_say) as database:
        _, any_there = database.access(None)
    if not serve.on_loopback and not any_there:
        raise UsageError(
            f"{serve.host} is reached from other machines, and nobody has a token: make one with "
            "`semdb token create --role admin`, or leave out --host"
        )


def from_environment() -> ASGIApp:
    """What each of several processes runs."""
    settings, serve = Settings(), ServeSettings()
    PatientProtocol.head_s = serve.body_timeout_s
    _log(settings)
    try:
        return make_app(open_service(settings, serve))
    except SemdbError as error:
        event("refused", level=logging.ERROR, error=str(error))
        raise SystemExit(error.exit_code) from None


def serve_forever(settings: Settings, serve: ServeSettings) -> None:
    """Runs until a signal says to stop; what runs then is ended in `stop_timeout_s`. Raises SemdbError."""
    import uvicorn

    check(settings, serve)
    PatientProtocol.head_s = serve.body_timeout_s
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # what the web server raises again when it has stopped
    options = {
        "host": serve.host,
        "port": serve.port,
        "access_log": False,
        "log_config": None,
        "server_header": False,
        "proxy_headers": False,
        "timeout_graceful_shutdown": int(serve.stop_timeout_s) + 1,
        "ssl_certfile": None if serve.tls_certificate is None else str(serve.tls_certificate),
        "ssl_keyfile": None if serve.tls_key is None else str(serve.tls_key),
        "ws_max_size": int(serve.max_upload_mb * 2**20),
        "ws_max_queue": 2,  # a client that sends more waits
        "ws_ping_interval": 20.0,
        "h11_max_incomplete_event_size": 64 * 1024,
        "http": PatientProtocol,
    }
    if serve.workers == 1:
        _log(settings)
        uvicorn.run(make_app(open_service(settings, serve)), **options)  # type: ignore[arg-type]
        return
    with _shared(settings, serve):
        _log(settings)
        uvicorn.run("semdb.service.run:from_environment", factory=True, workers=serve.workers, **options)  # type: ignore[arg-type]


@contextmanager
def _shared(settings: Settings, serve: ServeSettings) -> Iterator[None]:
    """The environment that several processes begin with: settings, a secret, a folder for their counters."""
    given = {f"SEMDB_{name.upper()}": value for name, value in settings.model_dump(exclude_none=True).items()}
    given |= {f"SEMDB_SERVE_{name.upper()}": value for name, value in serve.model_dump(exclude_none=True).items()}
    given.setdefault("SEMDB_SERVE_SECRET", secrets.token_hex(32))
    with tempfile.TemporaryDirectory(prefix="semdb-metrics-") as folder:
        os.environ.update({name: str(value) for name, value in given.items()} | {MULTIPROCESS: folder})
        Path(folder).chmod(0o700)
        yield


def _log(settings: Settings) -> None:
    """Events on stderr, as text or JSON, those of the web server among them."""
    if settings.log_format == "json":
        log_to()
        handler = logging.getLogger("semdb").handlers[0]
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(PlainFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s")))
        logger = logging.getLogger("semdb")
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.INFO)
    for name in ("uvicorn", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler] if name == "uvicorn" else [], name != "uvicorn"
        logger.setLevel(logging.INFO)
