"""3D rotation about the origin."""
