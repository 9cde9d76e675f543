"""3D translation in norm space, the first stage of DC-Reg in 3D."""
