"""FMCW devices."""

from .fmcw import DeviceFmcw

__all__ = ["DeviceFmcw"]
