"""The thesis' Hopper, and how far its prediction can be taken."""
