"""Recordings that Python writes."""

from __future__ import annotations

import math
import os
from dataclasses import asdict
from types import TracebackType
from typing import Any, Dict, Optional, Type, Union

from . import _radome
from ._errors import ArgumentError
from ._radome import Frame, Waveform
from ._source import Gap, Label


class Recorder:
    """Writer of a recording: ``.mcap``, the vendor's ``.txt``, or a folder of the vendor's.

    The file has its name when the recorder is closed, and not at all if the ``with`` block ends by an exception.

    >>> with radome.open("auto") as source, radome.Recorder("night.mcap", source.waveform) as recorder:
    ...     for event in source.events():
    ...         recorder.write(event)
    """

    def __init__(self, path: Union[str, "os.PathLike[str]"], waveform: Waveform, *, overwrite: bool = False) -> None:
        self._native = _radome.Recorder(os.fspath(path), waveform, overwrite=overwrite)
        #: After closing: ``frames``, ``gaps``, ``frames_lost``, ``bytes``, and what the format ``omitted``.
        self.report: Optional[Dict[str, Any]] = None
        self._last_sequence: Optional[int] = None
        self._is_gap_told = False

    def write(self, event: Union[Frame, Gap, Label]) -> None:
        """Adds a frame, a gap or a label.

        Sequence numbers of frames rise. Where they jump and no gap was written since the frame before, a gap with the
        reason ``recorded`` is added. Raises :class:`ArgumentError` for a frame that does not come after the one before, and
        for a label whose times, name or confidence cannot be; neither is written.
        """
        if isinstance(event, Frame):
            self._frame(event)
        elif isinstance(event, Gap):
            self._native.gap(asdict(event))
            self._is_gap_told = True
        elif isinstance(event, Label):
            _check_label(event)
            self._native.label(asdict(event))
        else:
            raise TypeError(f"{type(event).__name__} is no Frame, Gap or Label")

    def _frame(self, frame: Frame) -> None:
        last = self._last_sequence
        if last is not None and frame.sequence <= last:
            raise ArgumentError(
                f"frame {frame.sequence} comes after frame {last}, but sequence numbers rise",
                "write frames in their order, and give Frame.from_array their sequence",
            )
        if last is not None and frame.sequence > last + 1 and not self._is_gap_told:
            missing = Gap(last + 1, frame.sequence - last - 1, "recorded")
            self._native.gap(asdict(missing))
            self._is_gap_told = True
        self._native.frame(frame)
        self._last_sequence, self._is_gap_told = frame.sequence, False

    def close(self) -> None:
        """Completes the recording and waits until it is on the disk."""
        report = self._native.finish()
        self.report = report if report is not None else self.report

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], _value: Optional[BaseException], _trace: Optional[TracebackType]
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._native.discard()


def _check_label(label: Label) -> None:
    named = f"label {label.label!r} from {label.start_s} to {label.end_s} s"
    if not label.label.strip():
        raise ArgumentError(f"{named}: expected a name, such as 'empty', 'one' or 'two'")
    if not 0.0 <= label.start_s <= label.end_s < math.inf:
        raise ArgumentError(f"{named}: expected finite times from 0 on, the end not before the start")
    if label.confidence is not None and not 0.0 <= label.confidence <= 1.0:
        raise ArgumentError(f"{named}: confidence is {label.confidence}, expected 0 to 1")
