"""Grasping: what the object looks like, where it may be, and whether that is it."""
