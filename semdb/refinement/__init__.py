"""What needs more than one keyframe: steps of `semdb refine` on the rows of a map."""
