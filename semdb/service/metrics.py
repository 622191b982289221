"""Metrics of the service for Prometheus. With several processes, each adds to files that all of them read."""

from __future__ import annotations

import os
from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector

MULTIPROCESS = "PROMETHEUS_MULTIPROC_DIR"
_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


class Metrics:
    """Counters of one process."""

    def __init__(self, queued: Callable[[], int] = int, cameras: Callable[[], int] = int) -> None:
        several = MULTIPROCESS in os.environ
        self._registry = CollectorRegistry()
        own = None if several else self._registry
        self._queued, self._cameras = queued, cameras
        self.requests = Counter(
            "semdb_requests", "Requests by route and status", ("method", "route", "status"), registry=own
        )
        self.seconds = Histogram(
            "semdb_request_seconds", "Time of requests by route", ("route",), registry=own, buckets=_SECONDS
        )
        self.verdicts = Counter("semdb_localizations", "Localizations by map and verdict", ("verdict",), registry=own)
        self.frames = Counter("semdb_tracked_frames", "Frames of sessions by state", ("state",), registry=own)
        if several:
            MultiProcessCollector(self._registry)

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Counts a request; a path that no route has is counted as one."""
        route = route or "none"
        self.requests.labels(method if route != "none" else "any", route, str(status)).inc()
        self.seconds.labels(route).observe(seconds)

    def verdict(self, name: str) -> None:
        """Counts an answer."""
        self.verdicts.labels(name).inc()

    def tracked(self, state: str) -> None:
        """Counts a frame of a session."""
        self.frames.labels(state).inc()

    def text(self) -> bytes:
        """What Prometheus reads."""
        text: bytes = generate_latest(self._registry)
        inside = f"# TYPE semdb_localizations_inside gauge\nsemdb_localizations_inside {self._queued()}\n"
        cameras = f"# TYPE semdb_sessions gauge\nsemdb_sessions {self._cameras()}\n"
        return text + inside.encode() + cameras.encode()
