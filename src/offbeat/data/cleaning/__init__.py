"""Cleaning: clocks, duplicates, outages, repeated values, and the log of what was done."""
