"""Whether what a recording says of itself fits its images: poses, axes, depth scale, intrinsics, clocks."""

from __future__ import annotations

from semdb.recordings.check.findings import Finding, find
from semdb.recordings.check.sample import Report, check_recording

__all__ = ["Finding", "Report", "check_recording", "find"]
