"""Checks of arrays that come from Python."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Tuple

from ._errors import ArrayTypeError, ArrayValueError

if TYPE_CHECKING:
    # NumPy takes two thirds of the import, so what needs it imports it.
    import numpy as np

#: Largest code of the 12-bit ADC.
MAX_CODE = 4095


def codes(array: Any, shape: Tuple[int, int, int]) -> np.ndarray:
    """Codes as a contiguous array of native uint16, ``[rx][chirp][sample]``.

    Integers of any size and byte order are converted, and so are arrays that are not contiguous. An array that needs
    no conversion is returned as it is.
    """
    import numpy as np

    array = np.asarray(array)
    if array.dtype.kind not in "iu":
        raise ArrayTypeError(
            f"codes are {array.dtype}, expected integers",
            "give the ADC's codes, 0 to 4095; of samples from -1 to 1 they are ((x + 1) / 2 * 4095).round().astype('uint16')",
        )
    if array.shape != tuple(shape):
        raise ArrayValueError(
            f"codes have the shape {array.shape}, the waveform has {tuple(shape)}",
            "axes are [rx][chirp][sample]",
        )
    if array.size and (int(array.min()) < 0 or int(array.max()) > MAX_CODE):
        raise ArrayValueError(f"codes are from {array.min()} to {array.max()}, the ADC's are 0 to {MAX_CODE}")
    return np.require(array, dtype=np.uint16, requirements=["C", "A"])


def angles(array: Any, axes: int, what: str) -> np.ndarray:
    """Angles as a contiguous array of native float64 with so many axes."""
    import numpy as np

    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise ArrayTypeError(f"{what} is {array.dtype}, expected real numbers")
    if array.ndim != axes:
        raise ArrayValueError(f"{what} has {array.ndim} axes, expected {axes}")
    if not np.isfinite(array).all():
        raise ArrayValueError(f"{what} has a number that is not finite")
    return np.require(array, dtype=np.float64, requirements=["C", "A"])
