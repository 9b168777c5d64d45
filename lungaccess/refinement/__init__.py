"""Joint refinement of a plan's choices by nonlinear programming."""

from lungaccess.refinement.joint import refine

__all__ = ["refine"]
