"""Compiled kernels of the needle searches."""
