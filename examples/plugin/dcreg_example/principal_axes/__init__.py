"""Principal axes, then ICP."""
