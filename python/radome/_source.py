"""Sources of frames."""

from __future__ import annotations

import math
import operator
import os
from dataclasses import dataclass
from typing import Any, Dict, Iterator, List, Optional, Sequence, Tuple, Union

from . import _radome
from ._errors import ArgumentError, RadomeError
from ._radome import Frame, Waveform

_StrPath = Union[str, "os.PathLike[str]"]

#: Tolerance of a label's times, s: label files round start and length to microseconds.
_ROUNDING_S = 2e-6


@dataclass(frozen=True)
class Gap:
    """Frames that are missing.

    ``first_sequence`` is the number of the first one, ``frames`` how many there are (0 if unknown), ``reason`` one of
    ``fifo_overflow``, ``packet_lost``, ``crc``, ``queue_full``, ``disconnected`` and ``recorded``.
    """

    first_sequence: int
    frames: int
    reason: str


@dataclass(frozen=True)
class Label:
    """Label of a span of time, from ``start_s`` to ``end_s`` on the frames' own clock (:attr:`Frame.time_s`), s.

    ``label`` is ``"empty"``, ``"one"``, ``"two"`` or free text.
    """

    start_s: float
    end_s: float
    label: str
    who: Optional[str] = None
    confidence: Optional[float] = None
    made_ns: Optional[int] = None
    note: Optional[str] = None


_CLASSES = ("empty", "one", "two")


def label_of(frame: Frame, labels: Sequence[Label]) -> Optional[str]:
    """Class of a frame by labels, or by its own truth where there are none.

    ``None`` where no label holds the frame, and where a person enters or leaves during it.
    """
    named = [label for label in labels if label.label in _CLASSES]
    if not named:
        return None if frame.transition else frame.truth

    def at(time_s: float) -> Optional[str]:
        time_s += _ROUNDING_S
        return next((label.label for label in named if label.start_s <= time_s < label.end_s), None)

    request = frame.waveform.request
    first = at(frame.time_s)
    last = at(frame.time_s + request["chirps_per_frame"] * request["chirp_interval_s"])
    return first if last is None or last == first else None


def read_labels(path: _StrPath) -> List[Label]:
    """Labels of a file of another tool: ``.txt`` is an Audacity label track, ``.label`` a DEEPCRAFT file,
    ``.json`` a JSON array."""
    return [Label(**label) for label in _radome.read_labels(os.fspath(path))]


class Source(Iterator[Frame]):
    """Opened source of frames, made by :func:`open` and :func:`simulate`.

    Iterate over it for frames, or over :meth:`events` for frames and gaps. A frame stays valid when the source is
    closed. Threads may share a source: each frame goes to one of them. A source does not work in a fork of the process
    that opened it.

    >>> with radome.open("night.mcap") as source:
    ...     for frame in source:
    ...         print(frame.sequence, frame.codes.mean())
    """

    #: Gaps so far, the newest 10,000.
    gaps: List[Gap]
    #: Frames known to be missing so far.
    frames_lost: int

    def __init__(self, native: "_radome.Source") -> None:
        self._native = native
        self.gaps = []
        self.frames_lost = 0
        self._labels: Optional[List[Label]] = None

    def __iter__(self) -> "Source":
        return self

    def __next__(self) -> Frame:
        frame = self.next_frame()
        if frame is None:
            raise StopIteration
        return frame

    def next_frame(self, timeout_s: Optional[float] = None) -> Optional[Frame]:
        """The next frame, or ``None`` at the end. Raises :class:`TimeoutError` where none comes within ``timeout_s``, s."""
        while True:
            event = self._next_event(timeout_s)
            if not isinstance(event, Gap):
                return event

    def _next_event(self, timeout_s: Optional[float] = None) -> Union[Frame, Gap, None]:
        event = self._native.next_event(timeout_s)
        if not isinstance(event, dict):
            return event
        gap = Gap(**event)
        self.frames_lost += gap.frames
        self.gaps.append(gap)
        del self.gaps[:-10_000]
        return gap

    def events(self) -> Iterator[Union[Frame, Gap]]:
        """Frames and gaps in their order."""
        while True:
            event = self._next_event()
            if event is None:
                return
            yield event

    def close(self) -> None:
        """Stops the board or lets go of the file. A closed source gives no more frames."""
        self._native.close()

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def waveform(self) -> Waveform:
        """Waveform of all frames."""
        return self._native.waveform

    @property
    def description(self) -> str:
        """One line that says what the source is."""
        return self._native.description

    @property
    def is_live(self) -> bool:
        """Whether the source is a board, which does not wait for slow readers."""
        return self._native.is_live

    @property
    def board(self) -> Optional[Dict[str, Any]]:
        """What the board says of itself; ``None`` without a board."""
        return self._native.board

    @property
    def labels(self) -> List[Label]:
        """Labels of the recording; empty for other sources."""
        if self._labels is None:
            self._labels = [Label(**label) for label in self._native.labels]
        return self._labels

    def label_of(self, frame: Frame) -> Optional[str]:
        """Class of a frame by the recording's labels, or by its own truth where there are none."""
        return label_of(frame, self.labels)

    @property
    def frame_count(self) -> Optional[int]:
        """Frames in total; ``None`` where the source does not know."""
        return self._native.frame_count

    def __repr__(self) -> str:
        return f"<radome.Source {self.description}>"


def open(  # noqa: A001 - users write radome.open
    source: _StrPath,
    *,
    waveform: Union[Waveform, _StrPath, None] = None,
    frames: Optional[int] = None,
    seed: int = 1,
    people: Optional[int] = None,
    tolerance_db: Optional[float] = None,
    speed: Optional[float] = None,
    give_up_after_s: Optional[float] = None,
) -> Source:
    """Opens a SOURCE of frames, as the program ``radome`` names them.

    ==============================  ===============================================================
    a path                          recording: MCAP file, vendor's folder, vendor's text
    ``SCENE.toml``                  simulation
    ``serial:/dev/ttyACM0``         board on that port
    ``usb:``, ``usb:1-4``           board with bulk firmware
    ``deepcraft:/dev/ttyACM0``      PSoC 6 kit
    ``auto``                        the one board attached
    ``emulated:PATH``               the frames of a scene or recording through an emulated board
    ==============================  ===============================================================

    :param waveform: waveform to program a board with or to simulate a scene in, or what :meth:`Waveform.load` takes
    :param frames: frames after which the source ends; if ``None``, recordings end with their last frame, simulations
        and boards never
    :param seed: seed of everything random in a simulation
    :param people: people that a simulation has at most; the scene's own number if ``None``
    :param tolerance_db: error of a simulation's echoes that is asked for, dB; 0.5 if ``None``
    :param speed: times real time for recordings, simulations and emulated boards; as fast as it goes if
        ``None`` or 0
    :param give_up_after_s: time for which a board that is lost is looked for, s; 30 if ``None``
    """
    if waveform is not None and not isinstance(waveform, Waveform):
        waveform = Waveform.load(waveform)
    for name, count in (("seed", seed), ("people", people), ("frames", frames)):
        if count is not None and not 0 <= operator.index(count) < 2**64:
            raise ArgumentError(f"{name} is {count}, expected 0 to 2**64 - 1")
    for name, value in (("speed", speed), ("give_up_after_s", give_up_after_s)):
        if value is not None and not 0.0 <= value < math.inf:
            raise ArgumentError(f"{name} is {value}, expected 0 or a positive number")
    options = {
        "seed": operator.index(seed),
        "people": people,
        "frames": frames,
        "tolerance_db": tolerance_db,
        "speed": speed,
        "give_up_after_s": give_up_after_s,
    }
    return Source(_radome.Source.open(os.fspath(source), waveform, options))


def simulate(
    scene: _StrPath,
    *,
    frames: Optional[int] = None,
    seed: int = 1,
    people: Optional[int] = None,
    tolerance_db: Optional[float] = None,
    waveform: Union[Waveform, _StrPath, None] = None,
) -> Source:
    """Frames of a scene file, each with its truth (:attr:`Frame.truth`); see :func:`open` for the parameters.

    The same seed gives the same frames, bit by bit, on any number of threads.

    >>> with radome.simulate("fixtures/scenes/corridor.toml", frames=100) as frames:
    ...     people = [frame.truth for frame in frames]
    """
    if not os.fspath(scene).endswith(".toml"):
        raise RadomeError(f"{os.fspath(scene)} is no scene", "a scene is a .toml file; radome.open opens recordings")
    return open(
        scene, frames=frames, seed=seed, people=people, tolerance_db=tolerance_db, waveform=waveform
    )


def boards() -> List[Tuple[str, Dict[str, Any]]]:
    """Boards that may be attached: the SOURCE to open, and what the system says about the device."""
    return _radome.boards()
