"""Compiled kernels of the infeasibility proofs."""
