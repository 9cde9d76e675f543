"""The sections of the page, found by themselves.

A section is a module with ``ID``, ``TITLE``, ``POSITION`` and ``context(page)``, whose result is given to
the template ``templates/sections/<ID>.html``.
"""
