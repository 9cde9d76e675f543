"""Figures that are discovered automatically: each module here is one figure.

A module has ``POSITION`` (figures are shown in this order), ``CAPTION``, ``DRAWN`` (the roles of traces
that are visible at first and in print) and ``build(tables, styles)``, which returns a
`reports.figures.figure.Figure`, or None if the experiment has no runs for it. A figure of the paper
also has ``TITLE`` and ``PAPER``, see `reports.figures.paper`.
"""
