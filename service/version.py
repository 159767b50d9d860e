"""The version of the installed package."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def package_version() -> str:
    """Such as "0.1.0"; "0" where the package runs without being installed."""
    try:
        return version("lightwell")
    except PackageNotFoundError:
        return "0"
