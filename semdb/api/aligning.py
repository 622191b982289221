"""Recordings brought into one map, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from semdb.api.reading import Reading
from semdb.database.records import RecordingStatus
from semdb.errors import UsageError
from semdb.names import storable

if TYPE_CHECKING:  # as in `semdb.api.writing`
    from semdb.database.pose_records import PoseOperation
    from semdb.ingestion.run import Progress
    from semdb.refinement.align_report import AlignReport


class Aligning(Reading):
    """A database whose recordings can be moved."""

    def align(
        self,
        recording: str | None = None,
        *,
        map: str,
        source_map: str | None = None,
        name: str | None = None,
        joint: bool = False,
        dry_run: bool = False,
        progress: Progress | None = None,
    ) -> AlignReport:
        """Finds where a recording lies in `map` by localizing its keyframes there, and moves it into the map.

        `source_map` says which map it is in, where several have it; without `recording` all recordings of `source_map`
        move, as they lie to each other. `name` is the recording's in the map. With `joint` the map's own keyframes may
        move too. All poses change in one transaction, `undo_align` brings them back; nothing changes with `dry_run`,
        or where the report is not `convinced`. Raises NotFoundError, UsageError, ProvenanceError, DatabaseError.
        """
        from semdb.refinement.align import align_recordings

        store = self._store()
        target = store.find_map(map)
        return align_recordings(
            store,
            self._to_align(recording, source_map, target.id),
            target,
            name=None if name is None else storable(name),
            joint=joint,
            dry_run=dry_run,
            settings=self.settings,
            progress=progress,
            say=self._say,
        )

    def _to_align(self, recording: str | None, source_map: str | None, target: int) -> list[RecordingStatus]:
        if recording is None:
            if source_map is None:
                raise UsageError("say what to align: a recording, or with source_map= (--from) all of a map")
            found = self.recordings(source_map)
            if not found:
                raise UsageError(f"the map {source_map!r} holds no recording")
            return found
        if source_map is None:
            elsewhere = [one for one in self.recordings() if one.name == storable(recording) and one.map_id != target]
            if len(elsewhere) == 1:  # that of the map itself is not meant
                return elsewhere
        return [self.recording(recording, source_map)]

    def undo_align(self, recording: str | None = None, *, map: str | None = None) -> PoseOperation:
        """Takes back what moved a recording last (of `map`, where several have it), or moved anything of `map`.

        Returns what was taken back. Raises UsageError where there is nothing, or keyframes were moved again since;
        NotFoundError, DatabaseError.
        """
        from semdb.database.undoing import list_operations, undo

        store = self._store()
        if recording is not None:
            key = self.recording(recording, map).recording_id
            done = list_operations(store.engine, recording_id=key)
            what = f"the recording {recording!r}"
        elif map is not None:
            done = list_operations(store.engine, self._map_id(map))
            what = f"the map {map!r}"
        else:
            raise UsageError("say what to take back: a recording, or the last change of poses of a map (--map)")
        open_ones = [one for one in done if one.undone_at is None]
        if not open_ones:
            raise UsageError(f"nothing has moved {what}, or all of it was taken back")
        undo(store.engine, open_ones[0])
        return open_ones[0]
