"""One section per file: ID, TITLE, POSITION (sections are shown in this order), and `context(page)`.

`context` returns the variables of ``templates/sections/<ID>.html``, and may add figures and downloads to
the page. Without anything to show it may return None; the section is then left out.
"""
