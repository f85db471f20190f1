"""Descriptions of what a device measures: chirps, and loops over them.

Fields have the units that their names state. A sequence of one chirp is a loop over frames around a loop over chirps
around the chirp; a field ``sub_sequence`` or ``next_element`` holds an object whose ``contents`` is the element.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Dict, List, Optional


class ifxStructure:  # noqa: N801 - the name that scripts import
    """Base of all descriptions."""

    def to_dict(self, recursive: bool = False) -> Dict[str, Any]:
        """Fields and their values; those of descriptions inside as dicts if ``recursive``."""

        def plain(value: Any) -> Any:
            return value.to_dict(True) if recursive and isinstance(value, ifxStructure) else value

        names = [f.name for f in fields(self)]  # type: ignore[arg-type]
        return {name: plain(getattr(self, name)) for name in names if not isinstance(getattr(self, name), Link)}


class Link:
    """Holder of an element; false where there is none."""

    def __init__(self, contents: "Optional[FmcwSequenceElement]" = None) -> None:
        self.contents = contents

    def __bool__(self) -> bool:
        return self.contents is not None

    def __repr__(self) -> str:
        return f"Link({self.contents!r})"


class FmcwElementType(IntEnum):
    """Kinds of elements."""

    IFX_SEQ_LOOP = 0
    IFX_SEQ_CHIRP = 1
    IFX_SEQ_DELAY = 2


@dataclass
class FmcwSequenceChirp(ifxStructure):
    """One chirp. Bit 0 of a mask is the first antenna."""

    start_frequency_Hz: float = 0.0
    end_frequency_Hz: float = 0.0
    sample_rate_Hz: float = 0.0
    num_samples: int = 0
    rx_mask: int = 0
    tx_mask: int = 0
    tx_power_level: int = 0
    lp_cutoff_Hz: int = 0
    hp_cutoff_Hz: int = 0
    if_gain_dB: int = 0


@dataclass
class FmcwSequenceLoop(ifxStructure):
    """Repetitions of what is in ``sub_sequence``; without end where ``num_repetitions`` is 0."""

    sub_sequence: Link = field(default_factory=Link)
    num_repetitions: int = 0
    repetition_time_s: float = 0.0


@dataclass
class FmcwSequenceDelay(ifxStructure):
    """A pause."""

    wait_time_s: float = 0.0


@dataclass
class FmcwSequenceElement(ifxStructure):
    """Loop, chirp or delay, by ``type``, and what follows it."""

    type: int = FmcwElementType.IFX_SEQ_LOOP
    next_element: Link = field(default_factory=Link)
    loop: FmcwSequenceLoop = field(default_factory=FmcwSequenceLoop)
    chirp: FmcwSequenceChirp = field(default_factory=FmcwSequenceChirp)
    delay: FmcwSequenceDelay = field(default_factory=FmcwSequenceDelay)


@dataclass
class FmcwSimpleSequenceConfig(ifxStructure):
    """Frames of equal chirps."""

    frame_repetition_time_s: float = 0.0
    chirp_repetition_time_s: float = 0.0
    num_chirps: int = 0
    tdm_mimo: bool = False
    chirp: FmcwSequenceChirp = field(default_factory=FmcwSequenceChirp)


@dataclass
class FmcwMetrics(ifxStructure):
    """Resolutions and limits of frames."""

    range_resolution_m: float = 0.0
    max_range_m: float = 0.0
    max_speed_m_s: float = 0.0
    speed_resolution_m_s: float = 0.0
    center_frequency_Hz: float = 0.0


def create_dict_from_sequence(first_element: FmcwSequenceElement) -> List[Dict[str, Any]]:
    """A sequence as plain dicts, one for each element, for printing and saving."""
    elements: List[Dict[str, Any]] = []
    element: Optional[FmcwSequenceElement] = first_element
    while element is not None:
        kind = FmcwElementType(element.type)
        if kind == FmcwElementType.IFX_SEQ_CHIRP:
            elements.append({"chirp": element.chirp.to_dict(True)})
        elif kind == FmcwElementType.IFX_SEQ_DELAY:
            elements.append({"delay": element.delay.to_dict(True)})
        else:
            loop = element.loop.to_dict(True)
            inner = element.loop.sub_sequence.contents
            loop["sub_sequence"] = [] if inner is None else create_dict_from_sequence(inner)
            elements.append({"loop": loop})
        element = element.next_element.contents
    return elements


__all__ = [
    "FmcwElementType",
    "FmcwMetrics",
    "FmcwSequenceChirp",
    "FmcwSequenceDelay",
    "FmcwSequenceElement",
    "FmcwSequenceLoop",
    "FmcwSimpleSequenceConfig",
    "create_dict_from_sequence",
    "ifxStructure",
]
