"""Compiled parts of the route planner."""
