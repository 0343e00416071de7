"""Models: a recurrence composed of parts, the zoo of combinations, and checkpoints."""
