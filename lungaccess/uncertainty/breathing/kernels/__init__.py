"""Compiled kernels of the window of breathing."""
