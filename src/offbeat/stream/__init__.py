"""Streams: run a trained model on live messages."""
