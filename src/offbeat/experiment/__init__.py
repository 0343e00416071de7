"""Experiments: many runs, and what runs them."""
