"""The self-contained HTML report: ``python -m reports experiment TABLES OUT``.

A section of the page is one module in `reports.sections` with a template of the same name; a
figure is one file in `reports.figures`; everything visual is decided in `reports.theme`.
"""
