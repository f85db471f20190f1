"""The device."""

from __future__ import annotations

import math
import os
import uuid as uuids
import warnings
from pathlib import Path
from typing import Any, Dict, List, Optional

import numpy as np

from ... import Frame, Source, Waveform, boards
from ... import open as open_source
from ..._errors import FileError, RadomeError
from ..common.common_types import RadarSensor
from ..common.exceptions import (
    EndOfFrames,
    ErrorFrameAcquisitionFailed,
    ErrorNoDevice,
    ErrorNotSupported,
    ErrorTimeout,
)
from . import _sequence
from .types import FmcwElementType, FmcwMetrics, FmcwSequenceChirp, FmcwSequenceElement, FmcwSimpleSequenceConfig

#: Variable that names the SOURCE of devices without one.
SOURCE_VARIABLE = "RADOME_SOURCE"
#: Variable with the speed of recordings, scenes and emulated boards, times real time; as fast as they are read if unset.
SPEED_VARIABLE = "RADOME_SPEED"
#: Largest code of the ADC.
_MAX_CODE = 4095


def _uuid(text: Optional[str]) -> Optional[uuids.UUID]:
    """UUID that a text states; ``None`` if it states none."""
    try:
        return uuids.UUID(text or "")
    except ValueError:
        return None


def _board_with(wanted: uuids.UUID) -> str:
    """SOURCE of the board with this UUID; ``RADOME_SOURCE`` stands for every UUID, if it is set."""
    named = os.environ.get(SOURCE_VARIABLE)
    if named is not None:
        return named
    for source, _ in boards():
        try:
            # A board says who it is once it is configured.
            with open_source(source, waveform=Waveform.load("paper")) as opened:
                known = (opened.board or {}).get("uuid")
        except RadomeError:
            continue
        if _uuid(known) == wanted:
            return source
    raise ErrorNoDevice(f"no board has the UUID {wanted}", f"attach it, or name a SOURCE in {SOURCE_VARIABLE}")


def _is_file(source: str) -> bool:
    """Whether the frames are those of a scene or a recording, which have a waveform of their own."""
    return Path(source[len("emulated:") :] if source.startswith("emulated:") else source).exists()


class DeviceFmcw:
    """A BGT60TR13C: a board, an emulated board, a recording or a scene.

    :param uuid: SOURCE, one of :meth:`get_list`, or the UUID of a board, for which ``RADOME_SOURCE`` stands if it is set
    :param port: serial port of a board, or a SOURCE
    :param sensor_type: a device without frames, for what follows from a configuration

    Without a parameter the SOURCE is that of the environment variable ``RADOME_SOURCE``, or ``auto``. Recordings and
    scenes come as fast as they are read, or at ``RADOME_SPEED`` times their own pace. A device measures from :meth:`start_acquisition` or the first frame on.
    """

    #: Frames known to be missing so far.
    frames_lost: int

    def __init__(
        self,
        uuid: Optional[str] = None,
        port: Optional[str] = None,
        sensor_type: Optional[RadarSensor] = None,
    ) -> None:
        if sensor_type is not None and sensor_type != RadarSensor.BGT60TR13C:
            raise ErrorNotSupported(f"sensor_type is {sensor_type!r}, radome drives the BGT60TR13C")
        self._source_name = self._named(uuid, port, sensor_type)
        self._source: Optional[Source] = None
        self._sequence: Optional[FmcwSequenceElement] = None
        self._wanted: Optional[Waveform] = None
        self._known: Optional[Dict[str, Any]] = None
        self._last: Optional[Frame] = None
        self._is_closed = False
        self.frames_lost = 0

    @staticmethod
    def _named(uuid: Optional[str], port: Optional[str], sensor_type: Optional[RadarSensor]) -> Optional[str]:
        if uuid is not None:
            wanted = _uuid(uuid)
            return uuid if wanted is None else _board_with(wanted)
        if port is not None:
            return f"serial:{port}" if port.startswith("/dev/") else port
        if sensor_type is not None:
            return None
        return os.environ.get(SOURCE_VARIABLE, "auto")

    @classmethod
    def get_list(cls, sensor_type: Optional[RadarSensor] = None) -> List[str]:
        """Names of the boards attached; ``RADOME_SOURCE`` instead, if it is set."""
        if sensor_type is not None and sensor_type != RadarSensor.BGT60TR13C:
            return []
        named = os.environ.get(SOURCE_VARIABLE)
        return [named] if named is not None else [source for source, _ in boards()]

    # What follows from a configuration.

    @classmethod
    def create_simple_sequence(cls, config: FmcwSimpleSequenceConfig) -> FmcwSequenceElement:
        """Sequence of frames of equal chirps."""
        return _sequence.simple_sequence(config)

    @classmethod
    def metrics_from_sequence(cls, chirp_loop: FmcwSequenceElement) -> FmcwMetrics:
        """Resolutions and limits of a loop over chirps, by the band that is sampled."""
        return _sequence.metrics(chirp_loop)

    @classmethod
    def sequence_from_metrics(
        cls, metrics: FmcwMetrics, chirp_loop: FmcwSequenceElement, round_to_power_of_2: bool = True
    ) -> None:
        """Sets band, samples, chirps and chirp interval of a loop over chirps; the rest of the chirp stays."""
        _sequence.apply_metrics(metrics, chirp_loop, round_to_power_of_2)

    def get_chirp_sampling_bandwidth(self, chirp: FmcwSequenceChirp) -> float:
        """Band that is sampled, Hz."""
        return _sequence.lone_chirp(chirp).sampled_bandwidth_hz

    def get_chirp_sampling_center_frequency(self, chirp: FmcwSequenceChirp) -> float:
        """Middle of the band that is sampled, Hz."""
        return _sequence.lone_chirp(chirp).centre_frequency_hz

    def get_minimum_chirp_repetition_time(self, num_samples: int, sample_rate_Hz: float) -> float:
        """Shortest chirp interval, s."""
        return _sequence.shortest_chirp_s(int(num_samples), float(sample_rate_Hz))

    def get_element_duration(self, element: FmcwSequenceElement) -> float:
        """Duration of one element, s."""
        if element.type == FmcwElementType.IFX_SEQ_DELAY:
            return element.delay.wait_time_s
        if element.type == FmcwElementType.IFX_SEQ_CHIRP:
            return _sequence.shortest_chirp_s(element.chirp.num_samples, element.chirp.sample_rate_Hz)
        loop, inner = element.loop, element.loop.sub_sequence.contents
        if loop.num_repetitions == 0:
            raise RuntimeError("a loop without end has no duration")
        once_s = loop.repetition_time_s
        if once_s <= 0.0 and inner is not None:
            once_s = self.get_sequence_duration(inner)
        return loop.num_repetitions * once_s

    def get_sequence_duration(self, first_element: FmcwSequenceElement) -> float:
        """Duration of an element and of those that follow it, s."""
        following = first_element.next_element.contents
        rest_s = 0.0 if following is None else self.get_sequence_duration(following)
        return self.get_element_duration(first_element) + rest_s

    def set_acquisition_sequence(self, first_element: FmcwSequenceElement) -> None:
        """Configures the device. It measures anew from the next frame on."""
        wanted = _sequence.waveform(first_element)
        self.stop_acquisition()
        self._wanted, self._sequence = wanted, first_element

    def get_acquisition_sequence(self) -> FmcwSequenceElement:
        """Sequence of the device: the one that was set, or that of its source."""
        if self._sequence is None:
            wave = self._wanted if self._source_name is None else self._running().waveform
            self._sequence = _sequence.sequence_of(wave if wave is not None else Waveform.load("paper"))
        return self._sequence

    def create_dummy_from_device(self) -> "DeviceFmcw":
        """A device without frames and with the same configuration."""
        dummy = DeviceFmcw(sensor_type=RadarSensor.BGT60TR13C)
        dummy._wanted, dummy._sequence = self._wanted, self._sequence
        return dummy

    def save_register_file(self, filename: str) -> None:
        """Writes the chip's registers for the configuration: a line of name, address and content each."""
        wave = self._wanted if self._wanted is not None else _sequence.waveform(self.get_acquisition_sequence())
        lines = [f"{name} 0x{address:02X} 0x{value:06X}\n" for name, address, value in wave.registers()]
        Path(filename).write_text("".join(lines), encoding="ascii")

    def load_register_file(self, filename: str) -> None:
        """Not there: a waveform is set by :meth:`set_acquisition_sequence`."""
        raise ErrorNotSupported("register files are not read", "use set_acquisition_sequence")

    # What the board says of itself.

    def _identity(self) -> Dict[str, Any]:
        if self._known is None and self._source_name is not None:
            was_running = self._source is not None
            self._known = self._running().board or {}
            if not was_running:
                # The script has yet to say what is to be measured.
                self.stop_acquisition()
        return self._known or {}

    def get_board_uuid(self) -> str:
        """Identifier of the board; zeros where it has none."""
        return str(uuids.UUID(hex=self._identity().get("uuid") or "0" * 32))

    def get_sensor_type(self) -> RadarSensor:
        """Kind of the sensor."""
        return RadarSensor.BGT60TR13C

    def get_firmware_information(self) -> Dict[str, Any]:
        """Name and version of the firmware."""
        known = self._identity()
        numbers = [int(part) for part in str(known.get("firmware_version", "0.0.0")).split(".") if part.isdigit()]
        major, minor, build = (numbers + [0, 0, 0])[:3]
        return {
            "description": known.get("name", self._source_name or ""),
            "version_major": major,
            "version_minor": minor,
            "version_build": build,
            "extended_version": known.get("extended_version", ""),
        }

    def get_sensor_information(self) -> Dict[str, Any]:
        """What the chip can do."""
        return {
            "description": "BGT60TR13C",
            "num_tx_antennas": 1,
            "num_rx_antennas": 3,
            "max_tx_power": 31,
            "num_temp_sensors": 1,
            "min_rf_frequency_Hz": 57.4e9,
            "max_rf_frequency_Hz": 63.6e9,
            "min_adc_sampling_rate": 80e6 / 1023,
            "max_adc_sampling_rate": 4e6,
            "adc_resolution_bits": 12,
            "lp_cutoff_list": [500_000],
            "hp_cutoff_list": [20_000, 40_000, 70_000, 80_000],
            "if_gain_list": [18, 23, 28, 30, 33, 35, 38, 40, 43, 45, 48, 50, 55, 60],
        }

    def get_temperature(self) -> float:
        """Temperature of the chip at the last frame, degrees Celsius; not a number, with a warning, where the source does
        not report it, as boards under radome do not."""
        temperature_c = None if self._last is None else self._last.temperature_c
        if temperature_c is None:
            warnings.warn("the source does not report the chip's temperature", RuntimeWarning, stacklevel=2)
            return math.nan
        return temperature_c

    # Frames.

    def _running(self) -> Source:
        if self._is_closed:
            raise ErrorNoDevice("the device was closed at the end of its with block", "make a new DeviceFmcw")
        if self._source_name is None:
            raise ErrorNoDevice("the device was made without a board", "make it without sensor_type")
        if self._source is None:
            name = self._source_name
            wave = self._wanted
            if wave is None and not _is_file(name):
                # A board has to be told something before it says anything.
                wave = Waveform.load("paper")
            try:
                speed = os.environ.get(SPEED_VARIABLE)
                self._source = open_source(name, waveform=wave, speed=None if speed is None else float(speed))
            except FileError:
                raise
            except RadomeError as error:
                raise ErrorNoDevice(error.message, error.hint) from error
        return self._source

    def start_acquisition(self) -> None:
        """Starts to measure; without effect on a device that measures."""
        self._running()

    def stop_acquisition(self) -> None:
        """Stops; without effect on a device that does not measure. A recording or scene begins anew at the next start."""
        source, self._source = self._source, None
        if source is not None:
            source.close()

    def get_next_frame(self, timeout_ms: Optional[int] = None) -> List[np.ndarray]:
        """The next frame: a list of one array ``[rx][chirp][sample]``, float32, from -1 to 1."""
        source = self._running()
        try:
            frame = source.next_frame(timeout_ms * 1e-3 if timeout_ms else None)
        except TimeoutError as error:
            raise ErrorTimeout(f"no frame came within {timeout_ms} ms") from error
        except FileError:
            raise
        except RadomeError as error:
            raise ErrorFrameAcquisitionFailed(error.message, error.hint) from error
        self.frames_lost = source.frames_lost
        if frame is None:
            raise EndOfFrames(f"{source.description} has ended")
        self._last = frame
        samples = frame.codes.astype(np.float32)
        samples *= np.float32(2.0 / _MAX_CODE)
        samples -= np.float32(1.0)
        return [samples]

    def __enter__(self) -> "DeviceFmcw":
        return self

    def __exit__(self, *_exception: object) -> None:
        self._close()

    def _close(self) -> None:
        self._is_closed = True
        self.stop_acquisition()

    def __del__(self) -> None:
        # A device whose construction failed has no source.
        if getattr(self, "_source", None) is not None:
            self._close()


__all__ = ["DeviceFmcw", "SOURCE_VARIABLE", "SPEED_VARIABLE"]
