"""The report of the thesis' runs: tests and findings, tables, figures, the page."""
