"""A camera that moves through a map, frame after frame."""
