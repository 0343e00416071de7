"""Predictions, forecasts and fills in original units, and their scores."""
