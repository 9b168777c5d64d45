"""Compiled kernels of the reachability proofs."""
