"""Data: recorded or simulated trajectories, their preparation, and padded batches."""
