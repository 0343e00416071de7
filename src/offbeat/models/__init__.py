"""Models: parts around one recurrence, the zoo that names their combinations, checkpoints."""
