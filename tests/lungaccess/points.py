"""Targets in the small phantom that several tests use."""

FAR_TARGET = "lps:-48.4,-38.6,-7.8"
"""In no needle's workspace of the preset `ultrathin`, whatever the deployment."""
