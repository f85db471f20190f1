"""Classes with the public names of the vendor's Python SDK, over the sources of radome.

A script that was written for the SDK runs when ``radome.`` is put before ``ifxradarsdk`` in its imports. Where its
frames come from is a SOURCE as ``radome.open`` takes it, named by the environment variable ``RADOME_SOURCE``:
``auto`` (the default, the one board attached), a recording, a scene, or ``emulated:SCENE.toml``.

This is not the vendor's software and contains none of it. ``python/README.md`` says what is there and what is not.
"""

from .. import __version__


def get_version() -> str:
    """Version of radome."""
    return __version__


def get_version_full() -> str:
    """Version of radome, with its name."""
    return f"radome {__version__}"


__all__ = ["get_version", "get_version_full"]
