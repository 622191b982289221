"""Prometheus metrics of a worker and its processes, on an optional port."""

from __future__ import annotations

import os
import tempfile
from typing import Any

_metrics: dict[str, Any] = {}


def prepare() -> None:
    """Makes the metrics; called before the worker forks, so that its processes share a folder of counts."""
    os.environ.setdefault("PROMETHEUS_MULTIPROC_DIR", tempfile.mkdtemp(prefix="semdb-metrics-"))
    from prometheus_client import Counter

    if _metrics:
        return
    _metrics["keyframes"] = Counter("semdb_keyframes", "Keyframes done, by outcome", ["outcome"])
    _metrics["seconds"] = Counter("semdb_stage_seconds", "Seconds spent, by stage", ["stage"])
    _metrics["retries"] = Counter("semdb_retries", "Work that was run again: transactions and whole tasks", ["what"])


def serve(port: int) -> None:
    """Answers on `port` for all processes of this worker. Raises OSError when the port is taken."""
    from prometheus_client import CollectorRegistry, multiprocess, start_http_server

    prepare()
    registry = CollectorRegistry()
    multiprocess.MultiProcessCollector(registry)
    start_http_server(port, registry=registry)


def count(item: Any) -> None:
    """Counts a keyframe that is done."""
    if not _metrics:
        return
    _metrics["keyframes"].labels(item.outcome).inc()
    for stage, seconds in item.seconds.items():
        _metrics["seconds"].labels(stage).inc(seconds)


def retried(what: str) -> None:
    """Counts one retry of a transaction or a task."""
    if _metrics:
        _metrics["retries"].labels(what).inc()
