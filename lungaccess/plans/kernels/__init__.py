"""Compiled kernels of plans."""
