"""One figure per file: a query on the tables, as data for the page and for print."""
