"""Datasets: one folder each, with a card (facts) and, where no stock loader fits, a loader.

``data.registry.datasets()`` finds them all; nothing is downloaded until it is needed.
"""
