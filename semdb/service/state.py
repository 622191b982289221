"""What a process of the service has: one database with its networks and indexes, pools, settings."""

from __future__ import annotations

import contextvars
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from starlette.requests import HTTPConnection, Request
from starlette.websockets import WebSocket

from semdb.api import Database
from semdb.service.cameras import Sessions
from semdb.service.forms import Memory
from semdb.service.ingesting import Jobs, ingest_settings
from semdb.service.metrics import Metrics
from semdb.service.pool import Pool
from semdb.service.roles import Access, Rates
from semdb.service.settings import MIB, ServeSettings
from semdb.service.streams import Streams
from semdb.service.uploads import Uploads

T = TypeVar("T")
READERS, MOST_READS = 8, 256
MOST_WRITES = 8
STATEMENTS, MOST_STATEMENTS = 2, 8
DRAWERS, MOST_DRAWN = 2, 256  # of pictures and clouds: who asks for many delays nobody's token or list
_notes: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar("notes", default=None)


def note(line: str) -> None:
    """What the library assumed, for the request that it was asked in."""
    notes = _notes.get()
    if notes is not None and len(notes) < 20:
        notes.append(line)


def with_notes(work: Callable[[], T]) -> tuple[T, list[str]]:
    """The result of `work`, and what was assumed."""
    notes: list[str] = []
    token = _notes.set(notes)
    try:
        return work(), notes
    finally:
        _notes.reset(token)


@dataclass
class Service:
    """One database over HTTP."""

    database: Database
    settings: ServeSettings
    reading: Pool = field(init=False)
    localizing: Pool = field(init=False)
    statements: Pool = field(init=False)
    drawing: Pool = field(init=False)
    writing: Pool = field(init=False)
    sessions: Sessions = field(init=False)
    sockets: dict[WebSocket, str] = field(default_factory=dict)  # and who has them
    rates: Rates = field(init=False)
    secret: bytes = field(init=False, repr=False)
    metrics: Metrics = field(init=False)
    uploads: Uploads = field(init=False)
    jobs: Jobs | None = None
    streams: Streams = field(default_factory=Streams)
    forms: Memory = field(default_factory=Memory)
    stopping: bool = False

    def __post_init__(self) -> None:
        self.reading = Pool("reading", READERS, MOST_READS)
        self.localizing = Pool("localization", self.settings.cores, self.settings.queue)
        self.statements = Pool("statements", STATEMENTS, MOST_STATEMENTS)
        self.drawing = Pool("pictures", DRAWERS, MOST_DRAWN)
        self.writing = Pool("writing", 1, MOST_WRITES)
        self.rates = Rates(self.settings.rate, self.settings.burst)
        folder = self.settings.uploads or self.database.settings.cache_dir / "serve" / "uploads"
        self.uploads = Uploads(folder.expanduser().absolute(), int(self.settings.max_unpacked_mb * MIB))
        each = self.settings.sessions_per_token
        self.sessions = Sessions(self.settings.sessions, each, self.settings.session_idle_s)
        self.metrics = Metrics(lambda: self.localizing.inside, lambda: len(self.sessions))
        self.secret = (self.settings.secret or secrets.token_hex(32)).encode()

    def answered(self, verdict: str) -> None:
        """Counts an answer."""
        self.metrics.verdict(verdict)

    def start_jobs(self) -> None:
        """Begins to work off what is to be ingested."""
        settings = ingest_settings(self.database.settings, self.settings, self.uploads.folder)
        database = Database(settings, say=self.database._say)
        self.jobs = Jobs(database, self.settings, self.uploads, threading.Event())
        self.jobs.start()

    def wake_jobs(self) -> None:
        """There is a new job."""
        if self.jobs is not None:
            self.jobs.wake()

    def progress_of(self, job_id: int) -> tuple[str, int, int] | None:
        """What this process does for a job now."""
        return None if self.jobs is None else self.jobs.progress(job_id)

    def close(self) -> None:
        """Begins nothing more, waits for what runs, and closes the database."""
        self.stopping = True
        if self.jobs is not None:
            self.jobs.stop()
        for pool in (self.localizing, self.statements, self.drawing, self.writing, self.reading):
            pool.close()
        self.database.close()


def service_of(request: Request) -> Service:
    """That of the process."""
    found: Service = request.app.state.service
    return found


def access_of(request: HTTPConnection) -> Access:
    """What the request may do."""
    found: Access = request.state.access
    return found


async def read(request: Request, work: Callable[[Database], T]) -> T:
    """The result of a quick look at the database, in a thread."""
    service = service_of(request)
    return await service.reading.run(lambda: work(service.database))


async def draw(request: Request, work: Callable[[Database], T]) -> T:
    """The result of what decodes images, or goes through a whole map, in one of few threads."""
    service = service_of(request)
    return await service.drawing.run(lambda: work(service.database))


async def gone(request: Request) -> Any:
    """Returns when the client has gone away; the body must have been read."""
    while True:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            return message
