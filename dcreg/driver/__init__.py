"""From a checked problem to a result: modes, sampling, sweeps, compilation."""
