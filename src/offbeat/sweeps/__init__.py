"""Sweeps: many models over repeats that share windows, masks and splits."""
