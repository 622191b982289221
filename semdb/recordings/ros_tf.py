"""Transforms of a ROS bag: which frame hangs from which, and the pose of one in another at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from semdb.geometry import invert_pose, pose_from, rotation_from_quat_wxyz, slerp_wxyz
from semdb.types import FloatArray, Int64Array

LONGEST_GAP_NS = 1_000_000_000  # between two samples that are interpolated
BEYOND_END_NS = 20_000_000  # how long the first and the last sample hold
USUAL_WORLDS = ("map", "world", "odom")  # of several roots, in this order

Sample = tuple[int, FloatArray, FloatArray]  # time in ns, unit quaternion wxyz, translation


@dataclass(slots=True)
class Edge:
    """How `child` hangs from `parent`: samples of parent_from_child, one of which holds for ever where it is static."""

    parent: str
    child: str
    static: bool
    source: str  # the topic
    samples: list[Sample] = field(default_factory=list)
    _times: Int64Array | None = None

    def pose(self, time_ns: int) -> tuple[FloatArray | None, int]:
        """parent_from_child ``[4, 4]`` at a time, and how far the nearest sample is in ns; None where too far."""
        if self.static:
            _, quat_wxyz, translation = self.samples[-1]
            return pose_from(rotation_from_quat_wxyz(quat_wxyz), translation), 0
        if self._times is None:
            self.samples.sort(key=lambda sample: sample[0])
            self._times = np.array([sample[0] for sample in self.samples], dtype=np.int64)
        after = int(np.searchsorted(self._times, time_ns))
        near = [i for i in (after - 1, after) if 0 <= i < len(self.samples)]
        gap = min(abs(int(self._times[i]) - time_ns) for i in near)
        if len(near) == 1 or self._times[near[0]] == self._times[near[-1]]:
            index = near[0]
            if gap > BEYOND_END_NS:
                return None, gap
            return pose_from(rotation_from_quat_wxyz(self.samples[index][1]), self.samples[index][2]), gap
        (first_ns, first_q, first_t), (second_ns, second_q, second_t) = (self.samples[i] for i in near)
        if second_ns - first_ns > LONGEST_GAP_NS and gap > BEYOND_END_NS:
            return None, gap
        share = min(max((time_ns - first_ns) / (second_ns - first_ns), 0.0), 1.0)
        quat_wxyz = slerp_wxyz(first_q, second_q, share)
        return pose_from(rotation_from_quat_wxyz(quat_wxyz), (1 - share) * first_t + share * second_t), gap


class TransformTree:
    """All edges of a bag, by the frame that hangs."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def add(self, parent: str, child: str, sample: Sample, *, static: bool, source: str) -> None:
        """Adds a sample of parent_from_child. A frame keeps the parent of which it has the first sample."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not parent or not child or parent == child:
            return
        edge = self._edges.setdefault(child, Edge(parent, child, static, source))
        if edge.parent == parent and edge.source == source:
            edge.samples.append(sample)

    def has_parent(self, frame: str) -> bool:
        """Whether `frame` hangs from another."""
        return frame.lstrip("/") in self._edges

    def above(self, frame: str) -> list[str]:
        """The frames that `frame` hangs from, the nearest first; `frame` itself is the first."""
        found = [frame.lstrip("/")]
        while found[-1] in self._edges and self._edges[found[-1]].parent not in found:
            found.append(self._edges[found[-1]].parent)
        return found

    def moves(self, frame: str) -> list[Edge]:
        """The edges above `frame` that are not static."""
        return [self._edges[name] for name in self.above(frame)[:-1] if not self._edges[name].static]

    def frames(self) -> list[str]:
        """All frames that are named."""
        return sorted({edge.child for edge in self._edges.values()} | {edge.parent for edge in self._edges.values()})

    def pose(self, target: str, frame: str, time_ns: int) -> tuple[FloatArray | None, str]:
        """target_from_frame ``[4, 4]`` at a time; None and the reason where there is none."""
        above, others = self.above(frame), self.above(target)
        joint = next((name for name in above if name in others), None)
        if joint is None:
            return None, f"{frame!r} and {target!r} are not connected"
        ends = []
        for start in (frame, target):
            pose = np.eye(4)
            for name in self.above(start)[: self.above(start).index(joint)]:
                edge = self._edges[name]
                step, gap = edge.pose(time_ns)
                if step is None:
                    return None, f"no transform of {edge.child!r} in {edge.parent!r} (the nearest: {gap / 1e6:.0f} ms)"
                pose = step @ pose
            ends.append(pose)
        return np.asarray(invert_pose(ends[1]) @ ends[0]), ""


def best_world(tree: TransformTree, frame: str) -> str | None:
    """The frame in which `frame` moves, as far up as there is one; None where nothing above it moves."""
    moving = {edge.child for edge in tree.moves(frame)}
    above = tree.above(frame)
    highest = max((i for i, name in enumerate(above) if name in moving), default=None)
    if highest is None:
        return None
    names = above[highest + 1 :]
    return next((name for name in USUAL_WORLDS if name in names), names[0])


def unit(values: Iterable[float]) -> FloatArray | None:
    """A quaternion x, y, z, w as unit wxyz; None for what is none."""
    x, y, z, w = values
    quat = np.array([w, x, y, z], dtype=np.float64)
    norm = float(np.linalg.norm(quat))
    return quat / norm if np.isfinite(norm) and norm > 1e-6 else None
