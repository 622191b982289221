"""Settings of the service alone. Every field is an environment variable with the prefix ``SEMDB_SERVE_``."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from semdb.errors import UsageError
from semdb.settings import split_roots

MIB = 2**20


class ServeSettings(BaseSettings):
    """How the service listens, and what it allows."""

    model_config = SettingsConfigDict(env_prefix="SEMDB_SERVE_", extra="ignore")

    host: str = Field("127.0.0.1", description="address to listen at; another than loopback needs a token")
    port: int = Field(8765, ge=0, le=65535, description="port to listen at; 0: any that is free")
    workers: int = Field(1, ge=1, le=64, description="processes, each with networks and index of its own")
    hosts: str | None = Field(
        None, description="names that clients may call the service by, divided by commas; default: those of loopback"
    )
    secret: str | None = Field(
        None, min_length=16, description="signs sessions and confirmations; several services of one address share it"
    )
    tls_certificate: Path | None = Field(None, description="certificate chain, PEM; with it the service speaks HTTPS")
    tls_key: Path | None = Field(None, description="key of the certificate, PEM")
    pool: int = Field(0, ge=0, le=256, description="localizations at once in a process; 0: as many as it has cores")
    queue: int = Field(32, ge=0, le=10_000, description="localizations that wait; more are told to come again (429)")
    rate: float = Field(100.0, ge=0, description="requests a second of one token, in the long run; 0: any number")
    burst: int = Field(200, ge=1, description="requests of one token at once")
    max_upload_mb: float = Field(32.0, gt=0, description="largest body of a request with images, MiB")
    max_recording_mb: float = Field(4096.0, gt=0, description="largest recording that is uploaded, MiB")
    max_unpacked_mb: float = Field(16384.0, gt=0, description="largest recording that is unpacked from a zip, MiB")
    max_pixels: int = Field(50_000_000, ge=1, description="largest image, looked at before it is decoded")
    max_batch: int = Field(64, ge=1, le=1000, description="images of one request")
    page: int = Field(100, ge=1, le=1000, description="items of a list where no limit is asked for")
    sql_time_limit_s: float = Field(5.0, gt=0, description="time limit of a statement")
    sql_rows: int = Field(1000, ge=1, description="rows of a statement; more are left out, and that is said")
    sql_mb: float = Field(16.0, gt=0, description="largest answer of a statement, MiB; more rows are left out")
    body_timeout_s: float = Field(30.0, gt=0, description="a client that sends or takes nothing for so long is let go")
    request_timeout_s: float = Field(600.0, gt=0, description="the longest that a body may take to come")
    sessions: int = Field(64, ge=1, le=10_000, description="cameras tracked at once by a process; more: 429")
    sessions_per_token: int = Field(32, ge=1, le=10_000, description="of these for one token; more: 429")
    session_idle_s: float = Field(
        60.0, gt=0, description="a session of which nothing comes for so long lets its camera go"
    )
    session_hours: float = Field(12.0, gt=0, le=24 * 366, description="a session ends after so long")
    stop_timeout_s: float = Field(30.0, gt=0, description="what runs may take so long to end when the service stops")
    ingest_roots: str | None = Field(
        None, description="folders below which recordings to ingest may lie, divided by colons; default: none"
    )
    uploads: Path | None = Field(None, description="folder of uploads; default: serve/uploads in SEMDB_CACHE_DIR")
    uploads_days: float = Field(7.0, gt=0, description="uploads are deleted so long after they came")
    queries_days: float = Field(30.0, gt=0, description="the log of queries is forgotten after so long")

    @property
    def roots(self) -> tuple[str, ...]:
        """The folders of `ingest_roots`; () where nothing is set."""
        return () if self.ingest_roots is None else split_roots(self.ingest_roots)

    @property
    def allowed_hosts(self) -> frozenset[str]:
        """Names, in small letters and without port, that a client may call the service by."""
        names = {"localhost", "127.0.0.1", "::1", self.host.lower()}
        return frozenset(names | {name.strip().lower() for name in (self.hosts or "").split(",") if name.strip()})

    @property
    def on_loopback(self) -> bool:
        """Whether only programs of this machine reach the service."""
        return is_loopback(self.host)

    @property
    def cores(self) -> int:
        """Localizations at once in a process."""
        return self.pool or len(os.sched_getaffinity(0))

    @field_validator("ingest_roots")
    @classmethod
    def _ingest_roots(cls, text: str | None) -> str | None:
        if text is not None and any("://" in root for root in split_roots(text)):
            raise ValueError("names a URL: recordings to ingest lie in folders")
        return text


def is_loopback(host: str) -> bool:
    """Whether an address is one of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def serve_settings(given: Mapping[str, object]) -> ServeSettings:
    """The settings of the environment under those that are `given`. Raises UsageError naming the variable or option."""
    try:
        return ServeSettings(**given)  # type: ignore[arg-type]
    except ValidationError as error:
        problems = []
        for detail in error.errors():
            name = str(detail["loc"][0]) if detail["loc"] else ""
            where = f"--{name.replace('_', '-')} " if name in given else f"SEMDB_SERVE_{name.upper()}="
            shown = "..." if name == "secret" else detail["input"]
            problems.append(f"{where}{shown}: {detail['msg']}")
        raise UsageError("; ".join(problems)) from None
