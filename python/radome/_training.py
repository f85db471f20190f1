"""Training, adaptation, evaluation and export of models."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Callable, Dict, Iterable, List, Optional, Sequence, Tuple, Union

from . import _radome
from ._dataset import Dataset
from ._errors import ArgumentError
from ._radome import MapProcessor, Model
from ._source import Gap, Label, label_of
from ._source import open as open_source

_StrPath = Union[str, "os.PathLike[str]"]


@dataclass(frozen=True)
class Trained:
    """Result of a training.

    ``history`` has a dict for each epoch; ``validation`` and ``test`` are scores as :func:`evaluate` returns them,
    ``test`` is ``None`` without a test split; ``warnings`` are sentences.
    """

    model: Model
    history: List[Dict[str, Any]]
    validation: Dict[str, Any]
    test: Optional[Dict[str, Any]]
    warnings: List[str]


@dataclass(frozen=True)
class AdaptedModel:
    """Result of an adaptation.

    ``adapted`` says to what the model is adapted; ``held_out`` has for each recording the scores before and after by a
    model that was adapted on others, or ``None``; ``is_worse`` tells whether it judges recordings that were held out
    worse than before; ``is_measured`` tells of empty, one and two whether they were held out.
    """

    model: Model
    adapted: Dict[str, Any]
    held_out: List[Optional[Dict[str, Any]]]
    recordings_by_class: List[int]
    is_measured: List[bool]
    is_worse: bool


def networks() -> List[Dict[str, Any]]:
    """Networks that can be trained: name, parameters, multiply-adds and input of each."""
    return _radome.networks()


def train(
    dataset: Union[Dataset, _StrPath],
    settings: Union[Dict[str, Any], _StrPath, None] = None,
    *,
    network: Optional[str] = None,
    checkpoint: Optional[_StrPath] = None,
    report: Optional[Callable[[Dict[str, Any]], Any]] = None,
) -> Trained:
    """Trains a network on a dataset folder.

    The same dataset and settings give the same model, bit by bit. Ctrl-C ends the training behind the epoch.

    :param dataset: folder, or a :class:`Dataset` of all maps (or of ``split="train"``, which means the same): training,
        validation and test take their splits from it. Its ``rule`` divides it unless the settings have a ``split``;
        its ``transform`` is not used
    :param settings: keys of a training that differ from the defaults, or a TOML file with them
    :param network: name of a network, as :func:`networks` lists them
    :param checkpoint: file that holds the training after each epoch; a training that was stopped goes on from it. One training
        at a time may use it
    :param report: is called with a dict after each epoch; an exception of it ends the training

    >>> trained = radome.train("dataset", {"epochs": 10, "seed": 3}, report=print)
    >>> trained.model.save("model.safetensors")
    """
    given = settings if isinstance(settings, dict) else {} if settings is None else os.fspath(settings)
    native, rule = _whole(dataset)
    if rule:
        given = _with_rule(given, rule)
    file = None if checkpoint is None else os.fspath(checkpoint)
    model, scores = _radome.train(native, given, network, file, report)
    return Trained(model=model, **scores)


def _whole(dataset: Union[Dataset, _StrPath]) -> "Tuple[_radome.Dataset, Dict[str, Any]]":
    """All maps of a dataset, and the rule that divides them."""
    if not isinstance(dataset, Dataset):
        return _radome.Dataset(os.fspath(dataset)), {}
    if dataset.split not in (None, "train"):
        raise ArgumentError(
            f"the dataset is the split {dataset.split!r}, and maps to learn from are those of the training split",
            "give radome.Dataset(path) without split",
        )
    return dataset._native, dataset.rule


def _with_rule(settings: Union[Dict[str, Any], str], rule: Dict[str, Any]) -> Dict[str, Any]:
    """Settings with the rule of a dataset as their ``split``."""
    if not isinstance(settings, dict):
        raise ArgumentError(
            f"the dataset has a rule, and {settings} has settings too",
            "write the rule under [split] of that file and leave it out of radome.Dataset",
        )
    if settings.get("split", rule) != rule:
        raise ArgumentError(
            f"the dataset's rule is {rule} and the settings' split is {settings['split']}", "give one of them"
        )
    return {**settings, "split": rule}


def evaluate(model: Union[Model, _StrPath], dataset: Union[Dataset, _StrPath]) -> Dict[str, Any]:
    """Scores of a model over the maps of a dataset: ``samples``, ``confusion[truth][prediction]``, ``accuracy``,
    ``balanced_accuracy``, ``macro_f1``, ``populated_recall``, ``recall`` of each class, and the classes ``absent``.

    The split of a :class:`Dataset` without a rule of its own is that of the model's training if this is its dataset, so
    that the test split holds no map that the model was trained on.

    >>> radome.evaluate("model.safetensors", radome.Dataset("dataset", split="test"))["balanced_accuracy"]
    """
    model = model if isinstance(model, Model) else Model(os.fspath(model))
    dataset = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    rule = model.card.get("split")
    if dataset.split and rule and not dataset.rule and dataset._native.hash() == model.card["dataset_hash"]:
        dataset = Dataset(dataset.path, split=dataset.split, rule=rule)
    return model._evaluate(dataset._native, dataset.indices.tolist())


_Recording = Union[_StrPath, Tuple[_StrPath, Union[str, Sequence[Label], None]]]


def adapt(
    model: _StrPath, recordings: Iterable[_Recording], *, simulated: Union[Dataset, _StrPath, None] = None
) -> AdaptedModel:
    """Adapts a model to a room by recordings of it.

    :param model: model file, or ``"room-hqnn"`` for the built-in one
    :param recordings: sources, or pairs of a source and what is true of it: ``"empty"``, ``"one"``, ``"two"``, or a
        list of :class:`Label`. A source alone has the labels that it holds, or the truth of its frames. Two or more
        that show the same are held out in turn: that measures what is gained
    :param simulated: dataset whose training split is mixed in, so that the model keeps what it knows of other rooms. It is
        divided by the rule of the model's training. A :class:`Dataset` with a rule of its own is refused

    >>> result = radome.adapt("room-hqnn", [("empty.mcap", "empty"), ("me.mcap", "one")])
    >>> result.model.save("my-room.safetensors")
    """
    adapter = _radome.Adapter(os.fspath(model))
    if simulated is not None:
        native, rule = _whole(simulated)
        if rule:
            raise ArgumentError(
                f"the simulated dataset has the rule {rule}, and its training split is not divided by it",
                "give radome.Dataset(path) without rule",
            )
        adapter.mix(native)
    judging = Model(os.fspath(model))
    for recording in recordings:
        path, known = recording if isinstance(recording, tuple) else (recording, None)
        _add_recording(adapter, judging, path, known)
    adapted, scores = adapter.adapt()
    return AdaptedModel(model=adapted, **scores)


def _add_recording(
    adapter: "_radome.Adapter", model: Model, path: _StrPath, known: Union[str, Sequence[Label], None]
) -> None:
    with open_source(path) as source:
        model.check_waveform(source.waveform)
        processor = MapProcessor(source.waveform, model.rdm_spec)
        adapter.begin(source.waveform.frame_interval_s)
        labels = known if known is not None and not isinstance(known, str) else source.labels
        for event in source.events():
            if isinstance(event, Gap):
                processor.gap()
                continue
            if not event.has_signal:
                processor.reset()
                continue
            map = processor(event)
            if map is not None:
                label = known if isinstance(known, str) else label_of(event, labels)
                adapter.add(map, event.time_s, label)


def export(model: Union[Model, _StrPath], path: _StrPath, *, overwrite: bool = False) -> None:
    """Writes a model as ONNX (opset 17): input ``map`` ``[batch][1][range][doppler]``, float32, standardised; output
    ``logits`` ``[batch][3]``."""
    model = model if isinstance(model, Model) else Model(os.fspath(model))
    model.export(os.fspath(path), overwrite=overwrite)
