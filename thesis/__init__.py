"""The thesis' protocol: its runs, their record, its tables, figures and findings."""
