"""Searches for needle paths."""
