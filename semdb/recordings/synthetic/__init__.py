"""Synthetic recordings: a furnished, textured room rendered with exact depth, poses and instance masks."""

from __future__ import annotations

from semdb.recordings.synthetic.options import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticFrame, SyntheticSequence, write_synthetic_recording

__all__ = ["SyntheticFrame", "SyntheticOptions", "SyntheticSequence", "write_synthetic_recording"]
