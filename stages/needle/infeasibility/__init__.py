"""Proofs that there is no needle path."""
