"""The recording of a plan, opened again from where it was read: what workers do, and who needs its images again."""

from __future__ import annotations

from semdb.database.planning import StoredPlan
from semdb.database.pose_records import PoseSource
from semdb.database.pose_sources import load_planned_poses, recording_poses
from semdb.database.store import Store
from semdb.errors import RecordingError, RecordingUnavailableError
from semdb.ingestion.estimation import with_poses
from semdb.ingestion.plan import fingerprint
from semdb.recordings.base import Recording
from semdb.recordings.source import locate, open_located, parse_source
from semdb.settings import Settings


def open_planned(store: Store, plan: StoredPlan, settings: Settings, advice: str) -> Recording:
    """The recording of a plan, from where it was read. Raises what `open_located` raises.

    Raises RecordingUnavailableError, with `advice`, where it is not there, RecordingError where another one is.
    """
    found = parse_source(plan.source)
    folder = locate(found.address, settings)
    if not folder.exists():
        raise RecordingUnavailableError(f"{folder}: no such folder or file on this machine; {advice}")
    opened = open_located(folder, settings, found.parsed_camera, found.options)
    if len(opened) != 1:
        raise RecordingError(f"{folder}: on this machine there are {len(opened)} recordings, and one was planned")
    recording = opened[0]
    if recording_poses(store.engine, plan.recording_id).source is PoseSource.ESTIMATED:
        recording = with_poses(recording, load_planned_poses(store.engine, plan.recording_id))
    known = {entry.index: entry for entry in recording.entries}
    entries = [known[index] for index in plan.frame_indexes if index in known]
    if len(entries) == len(plan.frame_indexes) and fingerprint(recording, entries) != plan.fingerprint:
        raise RecordingError(
            f"{folder}: on this machine it is another recording than the one that was planned: its camera, or times or "
            "poses of keyframes differ"
        )
    return recording
