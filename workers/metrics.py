"""Prometheus metrics of a worker and its processes, on an optional port."""

from __future__ import annotations

import os
import shutil
import tempfile
from typing import Any

FOLDER = "PROMETHEUS_MULTIPROC_DIR"
_metrics: dict[str, Any] = {}
_made: list[str] = []  # folders of this worker's own


def prepare() -> None:
    """Makes the metrics; called before the worker forks, so that its processes share a folder of counts."""
    if FOLDER not in os.environ:
        _made.append(tempfile.mkdtemp(prefix="semdb-metrics-"))
        os.environ[FOLDER] = _made[-1]
    from prometheus_client import Counter

    if _metrics:
        return
    _metrics["keyframes"] = Counter("semdb_keyframes", "Keyframes done, by outcome", ["outcome"])
    _metrics["seconds"] = Counter("semdb_stage_seconds", "Seconds spent, by stage", ["stage"])
    _metrics["faults"] = Counter("semdb_faults", "Messages given back for a fault of this worker, by error", ["error"])
    _metrics["retries"] = Counter("semdb_retries", "Work that was run again: transactions and whole tasks", ["what"])


def serve(port: int) -> None:
    """Answers on `port` for all processes of this worker. Raises OSError when the port is taken."""
    from prometheus_client import CollectorRegistry, multiprocess, start_http_server

    prepare()
    registry = CollectorRegistry()
    multiprocess.MultiProcessCollector(registry)
    start_http_server(port, registry=registry)


def remove() -> None:
    """Removes the folder of counts where `prepare` made it; called when no process of the worker is left."""
    while _made:
        folder = _made.pop()
        if os.environ.get(FOLDER) == folder:
            del os.environ[FOLDER]
        shutil.rmtree(folder, ignore_errors=True)


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


def fault(error: str) -> None:
    """Counts a message that goes back because of this worker's own fault, which `error` names."""
    if _metrics:
        _metrics["faults"].labels(error).inc()
