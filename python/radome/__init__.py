"""Occupancy from a 60 GHz radar, in Python and NumPy.

>>> import radome
>>> counter = radome.Counter()
>>> with radome.open("emulated:fixtures/scenes/corridor.toml", frames=100) as source:
...     for frame in source:
...         map = radome.rdm(frame)
...         print(frame.sequence, counter(frame).label, map.db.max())

Conventions: SI units, and the unit stands in the name. Codes of a frame are ``[rx][chirp][sample]``, uint16, 0 to 4095.
Maps are ``[rx][doppler][range]``, float32, dB; velocity is positive when receding. Arrays of frames and maps are
read-only views: copy them to change them. Every error is a :class:`RadomeError` or of a class of Python's own.
"""

from ._errors import (
    ArgumentError,
    ArrayTypeError,
    ArrayValueError,
    ExistingFileError,
    FileError,
    ForbiddenFileError,
    MissingFileError,
    RadomeError,
)
from ._radome import Filter, Frame, Map, MapProcessor, Model, Waveform, rdm
from ._source import Gap, Label, Source, boards, label_of, open, read_labels, simulate
from ._circuit import Circuit, CircuitResult, circuit
from ._counter import CLASSES, Answer, Counter
from ._dataset import Dataset, DatasetWriter
from ._recorder import Recorder
from ._scene import Path, Paths, Person, paths, people
from ._training import AdaptedModel, Trained, adapt, evaluate, export, networks, train

__version__ = "0.1.0"

__all__ = [
    "AdaptedModel",
    "Answer",
    "ArgumentError",
    "ArrayTypeError",
    "ArrayValueError",
    "CLASSES",
    "Circuit",
    "CircuitResult",
    "Counter",
    "Dataset",
    "DatasetWriter",
    "ExistingFileError",
    "FileError",
    "Filter",
    "ForbiddenFileError",
    "Frame",
    "Gap",
    "Label",
    "Map",
    "MapProcessor",
    "MissingFileError",
    "Model",
    "Path",
    "Paths",
    "Person",
    "RadomeError",
    "Recorder",
    "Source",
    "Trained",
    "Waveform",
    "adapt",
    "boards",
    "circuit",
    "evaluate",
    "export",
    "label_of",
    "networks",
    "open",
    "paths",
    "people",
    "rdm",
    "read_labels",
    "simulate",
    "train",
]
