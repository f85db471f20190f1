"""Recordings that Python writes."""

from __future__ import annotations

import os
from dataclasses import asdict
from types import TracebackType
from typing import Any, Dict, Optional, Type, Union

from . import _radome
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

    def write(self, event: Union[Frame, Gap, Label]) -> None:
        """Adds a frame, a gap or a label."""
        if isinstance(event, Frame):
            self._native.frame(event)
        elif isinstance(event, Gap):
            self._native.gap(asdict(event))
        elif isinstance(event, Label):
            self._native.label(asdict(event))
        else:
            raise TypeError(f"{type(event).__name__} is no Frame, Gap or Label")

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
