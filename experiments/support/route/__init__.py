"""Tubes, baselines and timings for routes of limited curvature."""
