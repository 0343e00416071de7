"""Data: recorded or simulated trajectories, and their way to padded batches."""
