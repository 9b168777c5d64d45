"""Compiled kernels of the motions of a bronchoscope."""
