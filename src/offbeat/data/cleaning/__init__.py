"""Cleaning: clocks, duplicates, outages, repeated values, and the cleaning log."""
