"""Inference: predictions, filled gaps, forecasts, and the same live."""
