"""The trajectory of a recording from its images and depth: tracking, loop closures, pose graph, bundle adjustment."""
