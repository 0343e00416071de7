"""Figures. They draw what they are given."""
