"""Errors of the tube stage."""

from anatomy.base.errors import LungaccessError


class ConvergenceError(LungaccessError):
    """No equilibrium was found for given angles of the rear ends."""
