"""Figures and animations: they render records and plain arrays, and compute nothing."""
