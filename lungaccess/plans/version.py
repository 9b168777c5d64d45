"""The version of the software that plans and results state, and what its arithmetic was compiled from."""

from functools import cache

from anatomy.machine_code.sources import kernel_digest


@cache
def software_version() -> str:
    """Return the version of the installed package."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("lungaccess")
    except PackageNotFoundError:
        return "unknown"


def software_kernels() -> str:
    """Return the digest of the kernels that run here: the same version may have others, in a checkout."""
    return kernel_digest()


def made_by() -> dict[str, str]:
    """Return what answers that are not plans state of the software that gave them."""
    return {"software_version": software_version(), "kernels": software_kernels()}
