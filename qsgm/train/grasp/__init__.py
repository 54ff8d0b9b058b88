"""Drawn objects, tables and scenes: what the grasping task is meta-trained and judged on."""
