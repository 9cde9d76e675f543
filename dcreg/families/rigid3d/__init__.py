"""3D rigid poses."""
