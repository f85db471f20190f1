"""Exceptions with the names that scripts catch."""

from ..._errors import RadomeError


class GeneralError(RadomeError):
    """Any error of a device."""


class ErrorNoDevice(GeneralError):
    """No board, recording or scene is there."""


class ErrorParameterOutOfRange(GeneralError):
    """The chip cannot produce the sequence."""


class ErrorNotSupported(GeneralError):
    """radome does not have this function."""


class ErrorTimeout(GeneralError):
    """No frame came within the time."""


class ErrorFrameAcquisitionFailed(GeneralError):
    """The board stopped."""


class ErrorFifoOverflow(GeneralError):
    """Never raised here: frames that are lost are skipped and counted in ``DeviceFmcw.frames_lost``."""


class ErrorTemperatureMeasurementFailed(GeneralError):
    """Never raised here: a temperature that the source does not report is not a number."""


class EndOfFrames(GeneralError):
    """The recording or simulation has ended. The vendor's SDK has no such class, for its boards do not end."""


__all__ = [
    "EndOfFrames",
    "ErrorFifoOverflow",
    "ErrorFrameAcquisitionFailed",
    "ErrorNoDevice",
    "ErrorNotSupported",
    "ErrorParameterOutOfRange",
    "ErrorTemperatureMeasurementFailed",
    "ErrorTimeout",
    "GeneralError",
]
