"""One module per stage of the workflow: plan, fetch, generate, solve, evaluate, aggregate.

The rules in ``workflows/rules`` call them by ``python -m workflows``. `solve` runs methods in a
`sandbox` around a `worker` process.
"""
