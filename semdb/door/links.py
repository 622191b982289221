"""What ties keyframes together, as a database answers with it."""

from __future__ import annotations

from dataclasses import dataclass

from semdb.shown import for_terminal
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeLink:
    """Two keyframes of a map whose images say how they lie to each other.

    `kind` is ``odometry``, ``loop`` or ``session``, `state` ``accepted``, ``contradicted`` or ``failed``.
    `first_from_second` ``[4, 4]`` is the pose of the second in the first's frame, `information` ``[6, 6]`` of a right
    perturbation of it: translation (m) then rotation (rad). `off_m` and `off_deg`: by how much the poses that the
    keyframes have now differ from it.
    """

    map: str
    keyframe: int
    recording: str
    frame_index: int
    other_keyframe: int
    other_recording: str
    other_frame_index: int
    kind: str
    state: str
    first_from_second: FloatArray
    information: FloatArray
    inliers: int
    off_m: float
    off_deg: float
    reason: str
    provenance: str

    def __repr__(self) -> str:
        ends = f"{self.recording}/{self.frame_index} and {self.other_recording}/{self.other_frame_index}"
        return for_terminal(f"<{self.kind} of {ends}: {self.state}, {self.inliers} inliers>")
