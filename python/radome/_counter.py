"""Counting of people in a stream of frames."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Iterable, Iterator, Optional, Union

from ._radome import Filter, Frame, Model
from ._source import Gap

if TYPE_CHECKING:
    import numpy as np

#: Names of the classes: nobody, one person, two people. Their order is that of ``[class]`` in the probabilities of
#: models, and of the numbers 0, 1 and 2 in the labels of datasets.
CLASSES = ("empty", "one", "two")


@dataclass(frozen=True)
class Answer:
    """What a counter says to a frame.

    ``label`` is the most probable class behind the filter; ``probabilities`` those of ``CLASSES`` behind the filter,
    ``frame_probabilities`` those of the frame alone, both ``[class]``, float32. All three are ``None`` while a window
    over frames fills, and where no receiver that the model needs gives a signal.
    """

    sequence: int
    time_s: float
    label: Optional[str]
    probabilities: Optional[np.ndarray]
    frame_probabilities: Optional[np.ndarray]
    truth: Optional[str]


class Counter:
    """Counts people frame by frame: a model with the filter over its probabilities.

    Call it with the frames of one source in their order, or give :meth:`answers` the source.

    >>> with radome.open("emulated:fixtures/scenes/corridor.toml", frames=100) as source:
    ...     for answer in radome.Counter().answers(source):
    ...         print(answer.time_s, answer.label)
    """

    def __init__(self, model: Union[Model, str, "os.PathLike[str]"] = "room-hqnn") -> None:
        self.model = model if isinstance(model, Model) else Model(os.fspath(model))
        self._filter: Optional[Filter] = None
        self._last_time_s: Optional[float] = None

    def __call__(self, frame: Frame) -> Answer:
        """Answer to the next frame. A frame earlier than the one before begins anew."""
        time_s = frame.time_s
        if self._last_time_s is not None and time_s < self._last_time_s:
            # What was known of later frames says nothing of earlier ones.
            self.reset()
        self._last_time_s = time_s
        raw = self.model(frame)
        if raw is None:
            return Answer(frame.sequence, time_s, None, None, None, frame.truth)
        if self._filter is None:
            self._filter = self.model.filter(frame.waveform.frame_interval_s)
        filtered = self._filter.update(time_s, raw.tolist())
        label = CLASSES[int(filtered.argmax())]
        return Answer(frame.sequence, time_s, label, filtered, raw, frame.truth)

    def gap(self) -> None:
        """Forgets what needs consecutive frames."""
        self.model.gap()

    def reset(self) -> None:
        """Forgets all frames."""
        self.model.reset()
        self._filter = None
        self._last_time_s = None

    def answers(self, frames: Iterable[Union[Frame, Gap]]) -> Iterator[Answer]:
        """Answers to frames in their order: a source, ``source.events()`` or a list of frames."""
        events = getattr(frames, "events", None)
        for event in events() if events is not None else frames:
            if isinstance(event, Gap):
                self.gap()
            else:
                yield self(event)
