"""The claims of the paper, as checks over tables: ``claims.yaml`` states them, `checks` decides them.

`reports.ledger.judging` gives every claim a verdict; `reports.claims` is the command.
"""
