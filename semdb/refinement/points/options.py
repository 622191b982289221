"""What can be varied in refining the points of a map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace


@dataclass(frozen=True, slots=True)
class GateOptions:
    """`ceiling` is the greatest squared distance of unit descriptors of a pair (cosine 0.75).

    The gate is `first_px` wide at recorded poses, and three times the noise once two keyframes are laid on each other,
    at least `least_px` and at most `most_px`.
    """

    first_px: float = 24.0
    least_px: float = 4.0
    most_px: float = 12.0
    ratio: float = 0.85
    contradiction_ratio: float = 0.75
    ceiling: float = 0.5


@dataclass(frozen=True, slots=True)
class RegistrationOptions:
    """Standard deviations: of the recorded pose between two keyframes, the greatest that are believed (the points show
    how far off it is) and the least; `pixel_sigma_px` of a keypoint's pixel.
    """

    pose_m: float = 0.02
    pose_rad: float = 0.01
    least_m: float = 0.0005
    least_rad: float = 0.0003
    pixel_sigma_px: float = 1.0
    least_points: int = 12  # fewer leave the pose as recorded, and noise from its standard deviations


@dataclass(frozen=True, slots=True)
class DepthOptions:
    """`fuse` improves measured depths too; without it only missing ones are found.

    A depth needs `least_agreeing` other keyframes. A triangulated one needs a relative standard deviation of at most
    `most_relative`; where no keyframe measured the point, rays at least `least_parallax_deg` apart besides.
    """

    fuse: bool = True
    most_relative: float = 0.05
    least_parallax_deg: float = 1.5
    least_agreeing: int = 1


@dataclass(frozen=True, slots=True)
class BlindOptions:
    """What is different where no keyframe of a map has any depth, as in a model of COLMAP.

    Nothing tells a wrong match along an epipolar line then but a third keyframe, and nothing but these lines tells how
    far the poses are off: fewer metres and radians (one sigma) are believed.
    """

    least_agreeing: int = 2
    pose_m: float = 0.01
    pose_rad: float = 0.003


@dataclass(frozen=True, slots=True)
class FusionOptions:
    """How many keyframes look at each other, and what is made of it.

    Each is compared with the `neighbours` that have most in common with it (at least `least_share` of their points)
    among the `candidates` that look nearest by. `block` keyframes are worked on at a time.
    """

    neighbours: int = 8
    candidates: int = 32
    least_share: float = 0.2
    block: int = 128
    gate: GateOptions = field(default_factory=GateOptions)
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    depths: DepthOptions = field(default_factory=DepthOptions)
    blind: BlindOptions = field(default_factory=BlindOptions)

    def without_depth(self, keyframes: int) -> FusionOptions:
        """The options for a map of so many `keyframes` none of which has depth; two cannot be asked for a third."""
        registration = replace(self.registration, pose_m=self.blind.pose_m, pose_rad=self.blind.pose_rad)
        agreeing = self.blind.least_agreeing if keyframes > 2 else self.depths.least_agreeing
        return replace(self, registration=registration, depths=replace(self.depths, least_agreeing=agreeing))
