"""The library of problems with proven optima: how its problems are made, solved and run."""
