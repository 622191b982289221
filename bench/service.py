"""What HTTP costs over the library, and what a service does under load.

``python -m bench.service [RECORDING...] [--clients N] [--seconds S] [--queries N] [--json FILE]``. Some keyframes of
the recording become a map in a temporary SQLite file, which `semdb serve` opens in a process of its own. The same
queries go to the library here and to the service, in turn; then so many clients ask as fast as they can.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

import semdb
from semdb.recordings import open_recording
from semdb.service.instances import frame_with
from semdb.types import Frame

MODELS = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "surf"}


@contextmanager
def served(url: str, folder: Path, **settings: str) -> Iterator[tuple[httpx.Client, int]]:
    """A service in a process of its own: who asks it, and its number."""
    given = {"SEMDB_DATABASE_URL": url, "SEMDB_CACHE_DIR": str(folder / "cache"), "SEMDB_THREADS": "1", **settings}
    command = [sys.executable, "-m", "semdb.cli.main", "serve", "--port", "0"]
    with (folder / "serve.log").open("w") as log:
        process = subprocess.Popen(command, env=os.environ | given, stderr=log)
        try:
            with httpx.Client(base_url=address(process, folder / "serve.log"), timeout=120) as client:
                yield client, process.pid
        finally:
            process.terminate()
            process.wait(60)


def address(process: subprocess.Popen[bytes], log: Path) -> str:
    """Where the service listens."""
    while process.poll() is None:
        found = re.search(r"running on (http://\S+)", log.read_text())
        if found is not None:
            return found[1]
        time.sleep(0.1)
    raise SystemExit(log.read_text())


def form_of(frame: Frame) -> tuple[dict[str, str], dict[str, Any]]:
    """A frame as fields and files of a form, with its masks where it has some."""
    camera = frame.camera
    form = {"camera": ",".join(map(repr, (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)))}
    form["log"] = "false"
    files = {"image": ("image.png", bytes(cv2.imencode(".png", frame.image[..., ::-1])[1]))}
    if frame.instances is not None:
        form["categories"] = json.dumps({str(key): name for key, name in frame.instances.categories.items()})
        files["instances"] = ("instances.png", bytes(cv2.imencode(".png", frame.instances.labels)[1]))
    return form, files


def ask_library(database: Any, form: dict[str, str], files: dict[str, Any]) -> Any:
    """What the service does with a form: the same files are decoded, and the same is asked."""
    image = files["image"][1]
    if "instances" not in files:
        return database.localize(image, map="bench", camera=form["camera"], name="image", log=False)
    given = (image, None, files["instances"][1], form["categories"])
    frame = frame_with(*given, camera=form["camera"], depth_scale=None, name="image")
    return database.localize(frame, map="bench", name="image", log=False)


def in_turn(database: Any, client: httpx.Client, pid: int, frames: list[Frame], queries: int) -> dict[str, float]:
    """Milliseconds of the library here, of the service, and of what HTTP costs, each query by both in turn.

    Both get the same bytes. `overhead` is how long a client waits less what the library took there for the same
    request (Server-Timing); `difference` is the service less the library here, whose own times vary by more than that.
    Also of processor time, which other programs on the machine do not change much.
    """
    library, service, overhead = [], [], []
    here, there = 0.0, 0.0
    for number in range(queries + 3):
        form, files = form_of(replace(frames[number % len(frames)], depth=None))
        if number == 3:  # what is loaded at first is not counted
            library, service, overhead, here, there = [], [], [], 0.0, cpu_ms(pid)
        own, started = time.process_time(), time.perf_counter()
        wanted = ask_library(database, form, files)
        here += 1000 * (time.process_time() - own)
        between = time.perf_counter()
        answer = client.post("/v1/maps/bench/localize", data=form, files=files)
        ended = time.perf_counter()
        answer.raise_for_status()
        pose = wanted.world_from_camera
        if answer.json()["world_from_camera"] != (None if pose is None else pose.tolist()):
            raise SystemExit(f"query {number}: the service answers otherwise than the library")
        library.append(1000 * (between - started))
        service.append(1000 * (ended - between))
        overhead.append(service[-1] - float(answer.headers["Server-Timing"].rpartition("=")[2]))
    found = {"library_cpu_ms": here / queries, "service_cpu_ms": (cpu_ms(pid) - there) / queries}
    difference = [theirs - ours for theirs, ours in zip(service, library, strict=True)]
    of_each = {"library": library, "service": service, "difference": difference, "overhead": overhead}
    for name, values in of_each.items():
        found[f"{name}_p50_ms"], found[f"{name}_p95_ms"] = (float(np.percentile(values, q)) for q in (50, 95))
    return found


def under_load(url: str, frames: list[Frame], clients: int, seconds: float) -> dict[str, Any]:
    """Statuses, answers a second and their p95 of so many clients at once."""
    statuses: Counter[int] = Counter()
    taken: list[float] = []
    until = time.perf_counter() + seconds
    forms = [form_of(frame) for frame in frames]

    def ask(start: int) -> None:
        with httpx.Client(base_url=url, timeout=120) as client:
            number = start
            while time.perf_counter() < until:
                form, files = forms[number % len(forms)]
                started = time.perf_counter()
                answer = client.post("/v1/maps/bench/localize", data=form, files=files)
                statuses[answer.status_code] += 1
                if answer.status_code == 200:
                    taken.append(1000 * (time.perf_counter() - started))
                elif answer.status_code == 429:
                    time.sleep(float(answer.headers["Retry-After"]))
                number += 1

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(clients)]
    started = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    p95 = float(np.percentile(taken, 95)) if taken else float("nan")
    rate = len(taken) / (time.perf_counter() - started)
    return {"clients": clients, "statuses": dict(statuses), "load_p95_ms": p95, "answers_per_s": rate}


def cpu_ms(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return 1000 * (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mib(pid: int) -> float:
    """What a process holds."""
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--keyframes", type=int, default=8)
    parser.add_argument("--queries", type=int, default=100)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = []
    for path in arguments.recordings:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            recording = open_recording(path)
            models = MODELS if recording.categories is not None else {}
            url = f"sqlite:///{folder / 'bench.sqlite3'}"
            given: dict[str, Any] = {key.removeprefix("SEMDB_").lower(): value for key, value in models.items()}
            with semdb.open(url, cache_dir=folder / "cache", threads=1, **given) as database:
                database.ingest(path, map="bench", keyframes=arguments.keyframes)
                frames = [frame for number, frame in enumerate(recording.frames()) if number % 3 == 1][:20]
                with served(url, folder, **models) as (client, pid):
                    result: dict[str, Any] = {"recording": path.name}
                    result |= in_turn(database, client, pid, frames, arguments.queries)
                    before = memory_mib(pid)
                    load = under_load(str(client.base_url), frames, arguments.clients, arguments.seconds)
                    result |= load | {"memory_before_mib": before, "memory_after_mib": memory_mib(pid)}
            for key, value in result.items():
                print(f"{key:20} {value:.2f}" if isinstance(value, float) else f"{key:20} {value}")
            results.append(result)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
