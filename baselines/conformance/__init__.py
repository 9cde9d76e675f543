"""The rules of the contract, as functions that any method can be checked with.

``python -m baselines.check`` runs them on the methods of a package or a folder, and
``tests/contract/test_baselines.py`` on every method of this repository.
"""
