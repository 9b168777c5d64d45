"""Joint refinement of a plan's choices by nonlinear programming."""

from lungaccess.planning.refinement.joint import refine

__all__ = ["refine"]
