"""The pages of the problem library."""
