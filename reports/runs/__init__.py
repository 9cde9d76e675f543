"""What the browser of runs needs: a table of all runs, and details of each run, loaded on demand."""
