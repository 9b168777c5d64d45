"""Compiled parts of the tour planner."""
