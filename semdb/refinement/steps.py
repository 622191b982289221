"""The steps of `semdb refine`, in the order in which they are run."""

from __future__ import annotations

from semdb.database.landmark_rows import LANDMARKS
from semdb.refinement.class_step import ClassStep
from semdb.refinement.error_step import ErrorStep
from semdb.refinement.landmark_step import LandmarkStep
from semdb.refinement.point_step import PointStep
from semdb.refinement.pose_step import PoseStep
from semdb.refinement.step import Step

__all__ = ["FOR_LOCALIZATION", "LANDMARKS", "STEPS"]

STEPS: tuple[Step, ...] = (PoseStep(), ClassStep(), PointStep(), ErrorStep(), LandmarkStep())
FOR_LOCALIZATION = ("classes", "points", "errors")  # the steps that answers are made with, but for coarse ones
