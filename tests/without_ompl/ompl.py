"""Stands before OMPL on the path of tests that are run without it: pytest --without-ompl."""

raise ImportError("OMPL is kept away from these tests")
