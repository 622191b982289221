"""Before a recording becomes rows: what its images contradict stops the ingest, or is said and kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from semdb.database.records import RecordingFinding
from semdb.errors import RecordingError
from semdb.recordings.base import Recording
from semdb.recordings.check import Finding, check_recording

Progress = Callable[[str, int, int], None]


def check_before_ingest(recording: Recording, progress: Progress | None = None) -> list[RecordingFinding]:
    """What is likely wrong with how `recording` is read.

    Raises RecordingError for what is certain, with the option that mends it.
    """
    if all(entry.world_from_camera is None for entry in recording.entries):
        return []

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(f"checking {recording.name}", done, total)

    findings = check_recording(recording, progress=report).findings
    certain = [finding for finding in findings if finding.certain]
    if certain:
        raise RecordingError(refusal(recording, certain))
    return [as_row(finding) for finding in findings]


def refusal(recording: Recording, certain: Sequence[Finding]) -> str:
    """The message for findings that are certain."""
    reasons = "; ".join(finding.message for finding in certain)
    options = " ".join(finding.option for finding in certain if finding.option)
    mend = f"; say {options}" if options else ""
    told = f"its images contradict how it is read: {reasons}{mend}"
    return f"{recording.whereabouts}: {told} (--no-check ingests it as it is)"


def as_row(finding: Finding) -> RecordingFinding:
    """A finding as the database keeps it."""
    return RecordingFinding(finding.kind, finding.certain, str(finding.value), finding.option, finding.message)
