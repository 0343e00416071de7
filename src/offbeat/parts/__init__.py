"""The parts of a model: dynamics, updates and heads."""
