"""Streams: a trained model, live."""
