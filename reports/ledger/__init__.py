"""The claims of the paper as checks over tables: ``claims.yaml`` states them, `checks` computes them.

`reports.ledger.judging` gives every claim a verdict; ``python -m reports claims`` is the command.
"""
