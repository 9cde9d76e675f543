"""Sections of the page, in order. Each is a module with ID, TITLE and ``context(page) -> dict``;
its template is ``templates/sections/<ID>.html``.
"""

from reports.sections import (
    attribution,
    bounds,
    downloads,
    failures,
    gallery,
    levels,
    outcome,
    overview,
    paper,
    parameters,
    provenance,
)

ORDER = (
    outcome,
    paper,
    overview,
    levels,
    bounds,
    gallery,
    failures,
    attribution,
    parameters,
    provenance,
    downloads,
)
