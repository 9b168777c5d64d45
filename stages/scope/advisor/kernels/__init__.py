"""Compiled kernels of the bronchoscope stage."""
