"""Objects as things: what sightings of many keyframes have in common, where it stands, and what stands beside it."""
