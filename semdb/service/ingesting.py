"""Jobs: recordings are planned and left to workers, or ingested here where the database is a file."""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from semdb.api import Database
from semdb.database.engine import parse_url, sqlite_path
from semdb.database.jobs import DONE, FAILED, MOST_ATTEMPTS, PLANNED, WAITING, Job
from semdb.errors import DatabaseUnavailableError, LeaseLostError, RecordingUnavailableError, SemdbError
from semdb.events import event
from semdb.recordings.options import ReadOptions
from semdb.recordings.roots import check_root
from semdb.service.problems import Problem, scrubbed
from semdb.service.settings import ServeSettings
from semdb.service.uploads import Uploads
from semdb.settings import Settings

LOOK_S = 2.0
KEEP_S = 15.0
TIDY_S = 600.0
DAY_S = 86_400


def ingest_settings(settings: Settings, serve: ServeSettings, uploads: Path) -> Settings:
    """Settings with which nothing is opened but what lies below the roots and in uploads."""
    roots = ":".join([*serve.roots, str(uploads)])
    return settings.model_copy(update={"recording_roots": roots})


def path_below(given: str, roots: Sequence[str]) -> str:
    """The path of a recording, absolute or below one of the roots. Raises Problem 422, 501 where there is no root."""
    if not roots:
        raise Problem(501, "no folder is set of which recordings may be ingested: SEMDB_SERVE_INGEST_ROOTS")
    if "://" in given or "::" in given or "\0" in given or not given.strip():
        raise Problem(422, "path: the path of a folder or file is needed")
    options = [given] if given.startswith("/") else [str(Path(root) / given) for root in roots]
    for path in options:
        try:
            check_root(path, roots)
            if Path(path).exists():
                return path
        except (SemdbError, OSError, ValueError):
            continue
    raise Problem(422, "path: there is no such recording below the folders that are set")


class Jobs:
    """A thread that works off jobs, one after the other, and tidies up."""

    def __init__(self, database: Database, serve: ServeSettings, uploads: Uploads, stopping: threading.Event) -> None:
        self._database, self._serve, self._uploads, self._stopping = database, serve, uploads, stopping
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="semdb-jobs", daemon=True)
        self._progress: dict[int, tuple[str, int, int]] = {}
        self._here = sqlite_path(parse_url(database.settings.database_url)) is not None

    def start(self) -> None:
        """Begins."""
        self._thread.start()

    def wake(self) -> None:
        """There is a new job."""
        self._wake.set()

    def progress(self, job_id: int) -> tuple[str, int, int] | None:
        """What this process does for a job now: what, done and total."""
        return self._progress.get(job_id)

    def stop(self) -> None:
        """Ends after what it does now, or leaves it to another process."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(self._serve.stop_timeout_s)
        self._database.close()

    def _run(self) -> None:
        tidied = -TIDY_S
        while not self._stopping.is_set():
            try:
                if time.monotonic() - tidied > TIDY_S:
                    tidied = time.monotonic()
                    self._tidy()
                job = self._database.claim_job()
                if job is not None:
                    self._work(job)
                    continue
            except SemdbError as error:
                event("jobs", level=logging.WARNING, error=str(error))
            except Exception as error:  # the thread must live
                event("jobs", level=logging.ERROR, exc_info=error)
            self._wake.wait(LOOK_S)
            self._wake.clear()

    def _tidy(self) -> None:
        """Forgets what is older than the settings say."""
        days = self._serve.queries_days
        forgotten = self._database.forget_queries(int(days * DAY_S)), self._database.forget_jobs(int(days * DAY_S))
        uploads = self._uploads.forget(self._serve.uploads_days * DAY_S)
        if any(forgotten) or uploads:
            event("tidied", queries=forgotten[0], jobs=forgotten[1], uploads=uploads)

    def _work(self, job: Job) -> None:
        event("job", job=job.id, state="running", attempt=job.attempts)
        if job.attempts > MOST_ATTEMPTS:
            self._database.end_job(job, FAILED, error=job.error or "it was begun several times and never ended")
            return
        over = threading.Event()
        keeper = threading.Thread(target=self._keep, args=(job, over), daemon=True)
        keeper.start()
        try:
            result = self._ingest(job)
        except (DatabaseUnavailableError, RecordingUnavailableError, _Stopped) as error:
            event("job", job=job.id, state="given back", error=str(error))
            self._database.end_job(job, WAITING, error=scrubbed(error))
        except SemdbError as error:
            event("job", level=logging.ERROR, job=job.id, state="failed", error=str(error))
            self._database.end_job(job, FAILED, error=scrubbed(error))
        else:
            self._database.end_job(job, DONE if self._here else PLANNED, result)
            event("job", job=job.id, state="ended")
        finally:
            over.set()
            keeper.join()
            self._progress.pop(job.id, None)

    def _keep(self, job: Job, over: threading.Event) -> None:
        while not over.wait(KEEP_S):
            try:
                self._database.keep_job(job)
            except LeaseLostError:
                return
            except SemdbError as error:
                event("jobs", level=logging.WARNING, job=job.id, error=str(error))

    def _ingest(self, job: Job) -> list[dict[str, Any]]:
        asked = dict(job.request)

        def progress(what: str, done: int, total: int) -> None:
            if self._stopping.is_set():
                raise _Stopped("the service stops")
            self._progress[job.id] = (scrubbed(what), done, total)

        options: dict[str, Any] = {key: asked.get(key) for key in ("name", "keyframes", "stride", "camera")}
        reading = ReadOptions(depth_scale=asked.get("depth_scale"))
        more: dict[str, Any] = {"poses": asked.get("poses") or "auto", "check": bool(asked.get("check", True))}
        path = str(asked["path"])
        if self._here:
            found = self._database.ingest([path], map=job.map, reading=reading, progress=progress, **options, **more)
        else:
            found = self._database.queue(
                [path], _send(), map=job.map, reading=reading, progress=progress, **options, **more
            )
        return [
            {
                "map": one.map_name,
                "recording": one.recording,
                "keyframes": one.planned,
                "failed": {str(index): scrubbed(reason) for index, reason in one.failed.items()},
                "dropped": len(one.dropped),
            }
            for one in found
        ]


class _Stopped(Exception):  # noqa: N818 (nothing went wrong)
    """The service stops while a job runs."""


def _send() -> Callable[..., None]:
    """How keyframes are sent to workers. Raises UsageError without the worker extra."""
    from semdb.errors import UsageError

    try:
        return importlib.import_module("semdb.workers").send_items  # type: ignore[no-any-return]
    except ImportError as error:
        raise UsageError(str(error)) from error
