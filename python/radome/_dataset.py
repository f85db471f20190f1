"""Datasets of labelled maps."""

from __future__ import annotations

import operator
import os
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Optional, Sequence, Tuple, Type, Union

from . import _radome
from ._errors import ArgumentError
from ._radome import Map, Waveform

if TYPE_CHECKING:
    import numpy as np

_StrPath = Union[str, "os.PathLike[str]"]
_SPLITS = ("train", "validation", "test")


class Dataset:
    """Dataset folder as NumPy arrays.

    ``dataset[i]`` is a pair: the map ``[rx][doppler][range]``, float32 dB, a read-only view of the file, and its class:
    0 empty, 1 one person, 2 two. With ``len()`` that is what PyTorch's ``DataLoader`` takes; PyTorch is not imported.
    PyTorch warns of arrays that cannot be written to: give ``transform=numpy.array``, which copies. Datasets can be
    pickled and work in forked processes.

    :param split: ``"train"``, ``"validation"``, ``"test"`` or ``None`` for all maps
    :param transform: is called with each map
    :param rule: keys of the rule that divides sequences into splits: ``seed``, ``validation``, ``test``, ``by``,
        ``held_out``

    >>> training = radome.Dataset("dataset", split="train", transform=numpy.array)
    >>> loader = torch.utils.data.DataLoader(training, batch_size=32, shuffle=True)
    """

    def __init__(
        self,
        path: _StrPath,
        *,
        split: Optional[str] = None,
        transform: Optional[Callable[[np.ndarray], Any]] = None,
        rule: Optional[Dict[str, Any]] = None,
    ) -> None:
        import numpy as np

        if split is not None and split not in _SPLITS:
            raise ArgumentError(f"split is {split!r}, expected one of {', '.join(_SPLITS)} or None")
        #: Folder, absolute: it stays the same when the working directory changes.
        self.path = os.path.abspath(os.fspath(path))
        self.split = split
        self.transform = transform
        self.rule = dict(rule or {})
        self._native = _radome.Dataset(self.path)
        self._shards: Dict[int, np.ndarray] = {}
        self._names = sorted(Path(self.path).glob("maps-*.npy"))
        self._shard_length = 0
        all_labels = self._native.labels()
        if split is None:
            #: Index of each map in the folder, ``[map]``, int64.
            self.indices = np.arange(len(all_labels))
            if self.rule:
                # A rule that cannot be is refused here and not by a training later.
                self._native.splits(self.rule)
        else:
            self.indices = np.flatnonzero(self._native.splits(self.rule) == _SPLITS.index(split))
        #: Class of each map: 0 empty, 1 one, 2 two; ``[map]``, int64.
        self.labels = all_labels[self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def map(self, index: int) -> np.ndarray:
        """Map ``[rx][doppler][range]``, float32 dB, a read-only view of the file."""
        at = int(self.indices[index])
        if self._shard_length == 0:
            self._shard_length = len(self._shard(0))
        return self._shard(at // self._shard_length)[at % self._shard_length]

    def _shard(self, number: int) -> np.ndarray:
        import numpy as np

        shard = self._shards.get(number)
        if shard is None:
            shard = np.asarray(np.load(self._names[number], mmap_mode="r"))
            self._shards[number] = shard
        return shard

    def __getitem__(self, index: int) -> Tuple[Any, int]:
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"there is no map {index}: there are {len(self)}")
        cells = self.map(index)
        return (cells if self.transform is None else self.transform(cells)), int(self.labels[index])

    def __reduce__(self) -> Tuple[Any, ...]:
        return _reopened, (self.path, self.split, self.transform, self.rule)

    @property
    def rows(self) -> List[Dict[str, Any]]:
        """Rows of the manifest: ``domain``, ``scene``, ``recording``, ``sequence``, ``frame``, ``label`` and so on."""
        rows = self._native.rows()
        return [rows[index] for index in self.indices]

    @property
    def header(self) -> Dict[str, Any]:
        """What all maps share: waveform, map spec, shape, names of axes and classes."""
        return self._native.header

    @property
    def waveform(self) -> Waveform:
        """Waveform of the frames."""
        return self._native.waveform

    def verify(self) -> None:
        """Compares every map with its hash; raises an error for the first that differs."""
        for index in self.indices:
            self._native.verified_map(int(index))

    def __repr__(self) -> str:
        return f"<radome.Dataset {self.path}, {self.split or 'all'}: {len(self)} maps>"


def _reopened(path: str, split: Optional[str], transform: Any, rule: Dict[str, Any]) -> Dataset:
    return Dataset(path, split=split, transform=transform, rule=rule)


class DatasetWriter:
    """Writer of a dataset folder, map by map. The folder has its name when the writer is closed.

    :param map_spec: specification that the maps are made by: a preset's name or a dict, as for :func:`radome.rdm`

    >>> spec = {"channels": {"one": 0}, "static_removal": "slow_time_mean"}
    >>> with radome.DatasetWriter("dataset", waveform, spec) as writer:
    ...     writer.add(radome.rdm(frame, spec), "one", sequence="walk 3")
    """

    def __init__(self, path: _StrPath, waveform: Waveform, map_spec: Union[str, Dict[str, Any], None] = None) -> None:
        self._native = _radome.DatasetWriter(os.fspath(path), waveform, map_spec)

    def add(self, map: Map, label: str, *, sequence: str, **row: Any) -> None:
        """Adds a map with its class, ``"empty"``, ``"one"`` or ``"two"``.

        :param sequence: name of the frames that belong together: no two splits share one
        :param row: other keys of the manifest: ``scene``, ``recording``, ``domain`` (``"real"`` or ``"sim"``),
            ``subject``, ``frame``, ``time_ns``, ``transition``, ``split``, ``seed``
        """
        given = {"domain": "real", "scene": "", "recording": sequence, "frame": map.sequence, **row}
        self._native.add(map, {**given, "sequence": sequence, "label": label})

    def close(self) -> None:
        """Completes the dataset."""
        self._native.finish()

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], _value: Optional[BaseException], _trace: Optional[TracebackType]
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._native.discard()
