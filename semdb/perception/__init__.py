"""From an image to what semdb knows of it: objects, an embedding, keypoints with 3D points."""
