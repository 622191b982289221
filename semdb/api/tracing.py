"""Where the camera was, from images and depth alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from semdb.api.base import Base
from semdb.errors import UsageError

if TYPE_CHECKING:
    from semdb.door.protocol import Source
    from semdb.perception.protocols import Encoder
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.options import ReadOptions
    from semdb.settings import Settings
    from semdb.trajectory.recording import Progress, RecordedTrajectory


class Tracing(Base):
    """Finds trajectories. The database is not asked, and nothing is stored."""

    def trajectory(
        self,
        source: Source,
        *,
        every: int = 1,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        depth_scale: float | None = None,
        progress: Progress | None = None,
    ) -> RecordedTrajectory:
        """The trajectory of a recording, whatever poses it has itself.

        `source` is the folder or URL of one recording, or an iterable of `Frame` with depth, which go to a temporary
        folder as they come; `every` takes every N-th frame. `camera`, `reading` and `depth_scale` are as of `ingest`.
        Places are told by the encoder of the settings where one is named. `progress` is told what, done and total.
        Raises RecordingError for a recording without depth or in which nothing can be placed, UsageError, ModelError.
        """
        from semdb.api.sources import ingest_options, open_source
        from semdb.recordings.dropped import lines_of_opening
        from semdb.trajectory.recording import find_recorded

        options = ingest_options(None, "frames", None, None, camera, reading, depth_scale)
        encoder = encoder_named(self.settings)
        with open_source(source, self.settings, options, progress, lambda _options, _masks: None) as recordings:
            if len(recordings) != 1:
                names = ", ".join(recording.name for recording in recordings)
                raise UsageError(f"a trajectory is of one recording, but these are {len(recordings)}: {names}")
            for line in lines_of_opening(recordings[0]):
                self._say(line)
            return find_recorded(recordings[0], every=every, encoder=encoder, progress=progress)


def encoder_named(settings: Settings) -> Encoder | None:
    """The place encoder that the settings name; None where they name none: a trajectory needs no model file."""
    from semdb.perception.encoders import load_encoder

    return None if settings.encoder == "auto" else load_encoder(settings.encoder, settings)
