"""Answers in original units: predictions, filled gaps, forecasts, and their scores."""
