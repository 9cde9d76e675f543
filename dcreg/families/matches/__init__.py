"""3D rigid poses over a list of correspondences."""
