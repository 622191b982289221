"""What services were asked to ingest, kept in the database until it is done."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from semdb.api.base import Base

if TYPE_CHECKING:
    from semdb.database.jobs import Job


class Working(Base):
    """Adds, claims and ends jobs. What a job is to do is up to whoever claims it."""

    def add_job(self, map: str, who: str, request: Mapping[str, Any]) -> int:
        """The id of a new job."""
        from semdb.database.jobs import add_job

        return add_job(self._store(create=True).engine, map, who, request)

    def job(self, job_id: int) -> Job:
        """What became of a job. Raises NotFoundError."""
        from semdb.database.jobs import find_job

        return find_job(self._store().engine, job_id)

    def jobs(
        self, map: str | None = None, *, who: str | None = None, before: int | None = None, limit: int = 100
    ) -> list[Job]:
        """The newest jobs of a map, or of all, or of whoever asked for them; `before` the id of the last known one."""
        from semdb.database.jobs import list_jobs

        return list_jobs(self._store().engine, map, who=who, before=before, limit=limit)

    def open_jobs(self) -> int:
        """How many jobs wait or run."""
        from semdb.database.jobs import open_jobs

        return open_jobs(self._store().engine)

    def claim_job(self) -> Job | None:
        """The oldest job that nobody works on, for a minute; None where there is none."""
        from semdb.database.jobs import claim_job

        return claim_job(self._store().engine)

    def keep_job(self, job: Job) -> None:
        """Keeps a claimed job for another minute. Raises LeaseLostError where another process has it."""
        from semdb.database.jobs import keep_job

        keep_job(self._store().engine, job)

    def end_job(
        self, job: Job, state: str, result: list[dict[str, Any]] | None = None, error: str | None = None
    ) -> None:
        """Says what became of a claimed job: planned, done, failed, or waiting again."""
        from semdb.database.jobs import end_job

        end_job(self._store().engine, job, state, result, error)

    def forget_jobs(self, older_than_s: int) -> int:
        """Deletes jobs that ended more than so many seconds ago. Returns how many."""
        from semdb.database.jobs import forget_jobs

        return forget_jobs(self._store().engine, older_than_s)
