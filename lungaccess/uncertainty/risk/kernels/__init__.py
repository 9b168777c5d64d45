"""Compiled kernels of the risk."""
