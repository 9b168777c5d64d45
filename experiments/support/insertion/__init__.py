"""Simulated insertion of needles that do not follow their plans."""
