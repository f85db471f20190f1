"""Paths and people of a scene."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import List, Optional, Union

from . import _radome
from ._errors import ArgumentError


@dataclass(frozen=True)
class Path:
    """One path from the transmitter to one receiver.

    ``rx`` is the receiving antenna, from 1; ``kind`` is ``walls``, ``furniture`` or ``person``; ``surfaces`` are what
    the path meets, in order; ``person`` is the slot of the person whom it meets. ``length_m`` in m, ``delay_s`` in s,
    ``doppler_hz`` in Hz, positive where the path becomes shorter; ``gain_db`` is received over transmitted power, dB;
    ``phase_rad`` that of the received field, rad, from -pi to pi; ``points_m`` the corners of the path, m, empty where
    it has no single way.
    """

    rx: int
    kind: str
    surfaces: List[str]
    person: Optional[int]
    length_m: float
    delay_s: float
    doppler_hz: float
    gain_db: float
    phase_rad: float
    points_m: List[List[float]]


@dataclass(frozen=True)
class Paths:
    """Paths of a scene at the time ``time_s``, s. ``frequency_hz`` is the frequency of phases and Doppler shifts, Hz;
    ``people`` are the slots of the people who are there. Iterate over it, or take ``paths``."""

    scene: str
    seed: int
    time_s: float
    frequency_hz: float
    people: List[int]
    paths: List[Path]

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter(self.paths)

    def __getitem__(self, index: int) -> Path:
        return self.paths[index]


def paths(
    scene: Union[str, "os.PathLike[str]"],
    *,
    time_s: float = 0.0,
    seed: int = 1,
    people: Optional[int] = None,
    person: Optional[int] = None,
    margin_db: float = 10.0,
) -> Paths:
    """Every path from the transmitter to each receiver of a scene at one time.

    :param time_s: time from the first frame on, s
    :param person: only the paths by way of the person of this slot
    :param margin_db: paths this far below the noise of a cell of the map are left out, dB

    >>> strongest = max(radome.paths("fixtures/scenes/corridor.toml"), key=lambda path: path.gain_db)
    """
    options = {"time_s": time_s, "seed": seed, "people": people, "person": person, "margin_db": margin_db}
    found = _radome.paths(os.fspath(scene), options)
    if person is not None and person not in found["people"]:
        there = f"at that time these are there: {found['people']}" if found["people"] else "at that time nobody is there"
        raise ArgumentError(f"person {person} is not there at {time_s} s", there)
    return Paths(**{**found, "paths": [Path(**path) for path in found["paths"]]})


@dataclass(frozen=True)
class Person:
    """Where a person is in a frame: the middle of the chest in the middle of the frame.

    ``sequence`` and ``time_s`` are those of the frame; ``person`` is the person's number, from 0; ``in_room`` says whether
    any part of the body is in the room. ``position_m`` and ``velocity_m_per_s`` are in the axes of the scene, m and m/s.
    ``range_m`` is the distance from the radar, m; ``radial_velocity_m_per_s`` is positive where it increases;
    ``azimuth_deg`` is positive to the left of boresight, ``elevation_deg`` upwards, degrees.
    """

    sequence: int
    time_s: float
    person: int
    in_room: bool
    position_m: List[float]
    velocity_m_per_s: List[float]
    range_m: float
    radial_velocity_m_per_s: float
    azimuth_deg: float
    elevation_deg: float


def people(
    scene: Union[str, "os.PathLike[str]"], *, frames: int, seed: int = 1, people: Optional[int] = None
) -> List[Person]:
    """Where each person of a scene is in each frame, to compare trackers with. The frames are not simulated.

    :param frames: number of frames
    :param people: number of people, instead of the scene's own

    The people are those of :func:`simulate` with the same seed.

    >>> ranges_m = [person.range_m for person in radome.people("fixtures/scenes/corridor.toml", frames=100)]
    """
    options = {"frames": frames, "seed": seed, "people": people}
    return [Person(**person) for person in _radome.people(os.fspath(scene), options)]
