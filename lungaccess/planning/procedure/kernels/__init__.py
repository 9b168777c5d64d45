"""Compiled kernels of simulated procedures."""
