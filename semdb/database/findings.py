"""What a recording was found to contradict when it was ingested: the warnings that its row keeps."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, Engine, delete, insert, select

from semdb.database import retry
from semdb.database.records import RecordingFinding
from semdb.database.tables import recording_findings
from semdb.storable_names import NAME_LENGTH


def write_findings(engine: Engine, recording_id: int, findings: Sequence[RecordingFinding]) -> None:
    """Replaces the findings of a recording; of one kind the first is kept. Raises DatabaseError."""
    first = {finding.kind: finding for finding in reversed(findings)}

    def work(connection: Connection) -> None:
        connection.execute(delete(recording_findings).where(recording_findings.c.recording_id == recording_id))
        rows = [
            {
                "recording_id": recording_id,
                "kind": finding.kind,
                "certain": int(finding.certain),
                "value": finding.value[:NAME_LENGTH],
                "fix": finding.option[:NAME_LENGTH],
                "message": finding.message,
            }
            for finding in first.values()
        ]
        if rows:
            connection.execute(insert(recording_findings), rows)

    retry.write(engine, work)


def list_findings(engine: Engine) -> dict[int, list[RecordingFinding]]:
    """The findings of all recordings by id. Raises DatabaseError."""

    def work(connection: Connection) -> dict[int, list[RecordingFinding]]:
        c = recording_findings.c
        found: dict[int, list[RecordingFinding]] = {}
        for row in connection.execute(select(recording_findings).order_by(c.recording_id, c.kind)):
            finding = RecordingFinding(row.kind, bool(row.certain), row.value, row.fix, row.message)
            found.setdefault(int(row.recording_id), []).append(finding)
        return found

    return retry.read(engine, work)
