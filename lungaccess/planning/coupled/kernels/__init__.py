"""Compiled kernels of the coupled search."""
