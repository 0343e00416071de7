"""Policies cloned from uneven demonstrations: experts, rivals and their results."""
