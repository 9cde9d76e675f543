"""The problem library: how its problems are made, solved and run."""
