"""`semdb status` and `semdb retry`: what is stored of each recording, and trying again what failed."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options
from semdb.cli.output import print_json, print_lines, print_table
from semdb.shown import for_shell, measure

if TYPE_CHECKING:
    from semdb.api import Database, Status
    from semdb.database.records import FailedItem, RecordingStatus, Refinement

SECONDS_BETWEEN_LOOKS = 2.0
ERRORS_SHOWN = 10
COLUMNS = ("id", "map", "recording", "format", "state", "keyframes", "planned", "failed", "objects", "keypoints", "MiB")

MapName = Annotated[str | None, typer.Option("--map", metavar="MAP", help="Only the recordings of this map.")]


@settings_options(models=False)
def command(
    overrides: Overrides,
    map_name: MapName = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Look again every two seconds, until nothing is left to ingest.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Show what is planned, stored and failed of each recording."""
    rates, settings = Rates(), overrides.settings()
    with open_database(settings) as database:
        while True:
            status = database.status(map_name)
            recordings = status.recordings
            rates.look({recording.recording_id: recording.keyframes for recording in recordings})
            if json:
                refined = refinements_of(status.refinements)
                print_json([as_json(item, status.failed, refined.get(item.map_id, {})) for item in recordings])
            else:
                if watch and sys.stdout.isatty():
                    print("\033[2J\033[H", end="")  # clear, cursor to the top left
                show(status)
                if watch:
                    show_rates(recordings, rates)
                show_workers(database, everybody=watch)
            if not watch or all(recording.state in ("complete", "deleting") for recording in recordings):
                return
            time.sleep(SECONDS_BETWEEN_LOOKS)


class Rates:
    """Keyframes per second of each recording over the last looks."""

    def __init__(self, window_s: float = 30.0) -> None:
        self._window_s = window_s
        self._looks: list[tuple[float, dict[int, int]]] = []

    def look(self, counts: dict[int, int], now_s: float | None = None) -> None:
        """Takes note of the keyframes stored of each recording."""
        now_s = time.monotonic() if now_s is None else now_s
        self._looks = [look for look in self._looks if look[0] >= now_s - self._window_s] + [(now_s, counts)]

    def per_second(self, recording_id: int) -> float | None:
        """None until there are two looks at the recording."""
        (first_s, first), (last_s, last) = self._looks[0], self._looks[-1]
        if last_s <= first_s or recording_id not in first:
            return None
        return (last.get(recording_id, 0) - first[recording_id]) / (last_s - first_s)


def show_rates(recordings: Sequence[RecordingStatus], rates: Rates) -> None:
    """Print rates and the time left of recordings that are not complete."""
    from semdb.cli.progress import format_duration

    for recording in recordings:
        rate = rates.per_second(recording.recording_id)
        left = sum(recording.items.get(state, 0) for state in ("pending", "running"))
        if left and rate is not None:
            time_left = f", {format_duration(left / rate)} left" if rate > 0 else ""
            print_lines(f"{recording.map}/{recording.name}: {left} to do, {measure(rate, 1)} keyframes/s{time_left}")


def show_workers(database: Database, *, everybody: bool) -> None:
    """Print who works on how much, with `everybody`; where a broker is set also what waits unsent, and who is idle."""
    from importlib import import_module

    from semdb.errors import SemdbError

    busy = database.workers()
    for worker in busy if everybody else ():
        late = " (its lease has run out)" if worker.seconds_left < 0 else ""
        print_lines(f"worker {worker.machine} process {worker.process}: {worker.items} keyframes in hand{late}")
    if "broker_url" not in database.settings.model_fields_set:
        return
    if waiting := database.unsent():
        print_lines(
            f"{waiting} keyframes wait for which no message is known to be on its way: "
            "where no semdb ingest is at them, semdb ingest --resume sends them"
        )
    try:
        found = import_module("semdb.workers").nodes(database.settings)
    except (ImportError, SemdbError) as error:  # not installed, or the broker does not answer
        print_lines(f"workers: {error}")
        return
    at_work = {(worker.machine, worker.process) for worker in busy}
    for node in found:
        machine = node.name.partition("@")[2]
        idle = sum((machine, str(process)) not in at_work for process in node.processes)
        print_lines(f"worker {node.name}: {idle} of {len(node.processes)} processes idle")
    if not found:
        print_lines("workers: none answers at the broker")


def refinements_of(refinements: Iterable[Refinement]) -> dict[int, dict[str, str]]:
    """By map: each step of `semdb refine` that was run, and whether it is ``current`` or ``stale``."""
    found: dict[int, dict[str, str]] = {}
    for item in refinements:
        found.setdefault(item.map_id, {})[item.kind] = "current" if item.current else "stale"
    return found


def as_json(recording: RecordingStatus, failed: Iterable[FailedItem], refinements: dict[str, str]) -> dict[str, Any]:
    """What `--json` prints for one recording. `refinements` are those of its map."""
    return {
        "id": recording.recording_id,
        "map": recording.map,
        "recording": recording.name,
        "format": recording.format,
        "source": recording.source,
        "state": str(recording.state),
        "frames": recording.frame_count,
        "items": dict(recording.items),
        "keyframes": recording.keyframes,
        "objects": recording.objects,
        "keypoints": recording.keypoints,
        "image_bytes": recording.image_bytes,
        "refinements": refinements,
        "failed": [
            {"frame_index": item.frame_index, "attempts": item.attempts, "error": item.error}
            for item in failed
            if item.recording_id == recording.recording_id
        ],
    }


def show(status: Status) -> None:
    """Print the table for people, and the first errors."""
    recordings, failed = status.recordings, status.failed
    print_lines(f"database: {status.url}")
    if not recordings:
        print_lines("no recordings yet: semdb ingest PATH")
        return
    rows = [
        (
            r.recording_id,
            r.map,
            r.name,
            r.format,
            str(r.state),
            r.keyframes,
            sum(number for state, number in r.items.items() if state != "deleted"),
            r.items.get("failed", 0),
            r.objects,
            r.keypoints,
            float(measure(r.image_bytes / 2**20, 1)),
        )
        for r in recordings
    ]
    print_table(COLUMNS, rows)
    names = {recording.recording_id: recording.name for recording in recordings}
    for item in failed[:ERRORS_SHOWN]:
        print_lines(
            f"failed: {names[item.recording_id]} frame {item.frame_index}, attempt {item.attempts}: {item.error}"
        )
    if len(failed) > ERRORS_SHOWN:
        print_lines(f"and {len(failed) - ERRORS_SHOWN} more; --json lists all")
    shown = {recording.map_id for recording in recordings}
    for refined in status.refinements:
        if refined.map_id in shown and not refined.current:
            print_lines(f"map {refined.map}: what semdb refine computed ({refined.kind}) is out of date")


@settings_options(models=False)
def retry(overrides: Overrides, map_name: MapName = None) -> None:
    """Put keyframes that failed back into the plan.

    The next `semdb ingest` of their recording, or a worker, tries them again.
    """
    with open_database(overrides.settings()) as database:
        total = 0
        for recording, number in database.retry(map_name):
            total += number
            if number:
                print_lines(f"{recording.map}/{recording.name}: {number} put back; {ingest_again(recording)}")
    if total:
        print_lines("or, where workers do it: semdb ingest --resume")
    else:
        print_lines("nothing has failed")


def ingest_again(recording: RecordingStatus) -> str:
    """How to go on with a recording: the command with its own name and map that reads it as it was."""
    from semdb.recordings.options import option_of
    from semdb.recordings.source import parse_source
    from semdb.types import FROM_MEMORY

    if recording.format == FROM_MEMORY:
        return "its frames came from a program: give them to Database.ingest again"
    source = parse_source(recording.source)
    words = ["semdb", "ingest", source.address, "--map", recording.map, "--name", recording.name]
    said = [] if source.camera is None else ["--camera", source.camera]
    for name, value in source.options.given().items():
        said += [option_of(name), value]
    return f"run: {for_shell([*words, *said])}"
