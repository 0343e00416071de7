"""Writers of data sets and tables."""
