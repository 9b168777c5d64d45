"""Recorded needle queries, and the runs of planners on them."""
