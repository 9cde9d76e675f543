"""Spend hours of a machine on the runs that decide most claims: ``python -m reports evidence``.

A claim's next block is one more trial of each of its tests: all levels and shapes, for the methods that
the claim compares. After each block the ledger judges again, by intervals that are valid at every look.
Runs that only decided claims would use are left out (*not needed*). Which block comes next depends on the
tables alone, so a stopped campaign continues as if it had not been stopped.
"""
