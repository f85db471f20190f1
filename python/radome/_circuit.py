"""The quantum layer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Dict, NamedTuple, Optional

from . import _radome
from ._arrays import angles

if TYPE_CHECKING:
    import numpy as np


class CircuitResult(NamedTuple):
    """Expectations of a circuit, and their derivatives, 1/rad.

    Of one row of inputs the axis ``row`` is absent.
    """

    #: ``[row][observable]``, float64
    expectations: np.ndarray
    #: ``[row][observable][qubit]``, float64
    by_x: np.ndarray
    #: ``[row][observable][angle]``, float64
    by_theta: np.ndarray


class Circuit:
    """Circuit that encodes one input a qubit, turns the qubits by trained angles and measures Z on each.

    The default is the paper's: two qubits, ZZ feature map and RealAmplitudes, one repetition each, exact. Conventions
    are Qiskit's: the first output is Z on the highest qubit.

    :param settings: ``qubits``, ``encoding`` (``"zz_feature_map"``, ``"angle"``), ``repetitions``, ``depth``,
        ``execution`` (``"exact"`` or ``{"shots": {"count": 1000}}``), ``noise``

    >>> circuit = radome.Circuit()
    >>> circuit([0.5, 1.0], [0.1, 0.2, 0.3, 0.4])
    """

    def __init__(self, **settings: Any) -> None:
        self._native = _radome.Circuit(settings)

    @property
    def settings(self) -> Dict[str, Any]:
        """All settings."""
        return self._native.settings

    @property
    def qubits(self) -> int:
        """Number of inputs and of outputs."""
        return self._native.qubits

    @property
    def angle_count(self) -> int:
        """Number of trained angles."""
        return self._native.angle_count

    @property
    def observables(self) -> "list[str]":
        """Names of the outputs, such as ``["ZI", "IZ"]``."""
        return self._native.observables

    def __call__(self, x: Any, theta: Any, *, call: int = 0) -> np.ndarray:
        """Expectations ``[row][observable]`` of inputs ``x``, ``[row][qubit]`` or ``[qubit]``, rad, and angles
        ``theta``, ``[angle]``, rad. ``call`` numbers the draws of a circuit with shots."""
        rows, is_row = _rows(x)
        values = self._native.expectations(rows, angles(theta, 1, "theta"), call)
        return values[0] if is_row else values

    def jacobian(self, x: Any, theta: Any, *, call: int = 0) -> CircuitResult:
        """Expectations and their derivatives by inputs and angles."""
        rows, is_row = _rows(x)
        result = CircuitResult(*self._native.jacobian(rows, angles(theta, 1, "theta"), call))
        return CircuitResult(*(array[0] for array in result)) if is_row else result


def _rows(x: Any) -> "tuple[np.ndarray, bool]":
    import numpy as np

    x = np.asarray(x)
    is_row = x.ndim == 1
    return angles(x[None] if is_row else x, 2, "x"), is_row


_paper: Optional[Circuit] = None


def circuit(x: Any, theta: Any) -> CircuitResult:
    """The paper's layer of two qubits: expectations, and derivatives by inputs and angles.

    :param x: ``[row][2]`` or ``[2]``, rad
    :param theta: ``[4]``, rad

    >>> radome.circuit([0.5, 1.0], [0.1, 0.2, 0.3, 0.4]).by_theta
    """
    global _paper
    if _paper is None:
        _paper = Circuit()
    return _paper.jacobian(x, theta)
