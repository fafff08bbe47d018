"""Versions of the packages that rendered data depend on."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("mf-uavpose6d-edge", "numpy", "opencv-python-headless", "moderngl", "jsbsim", "av")


def packages() -> dict[str, str]:
    """The installed versions of PACKAGES, or a note that one is not installed."""
    return {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"
