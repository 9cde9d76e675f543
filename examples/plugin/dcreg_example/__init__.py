"""A method, a dataset and a metric that this package adds to the benchmark."""
