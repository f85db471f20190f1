"""From sequences to waveforms of radome, and back."""

from __future__ import annotations

import math
from typing import Tuple

from ... import Waveform
from ..._errors import RadomeError
from ..common.exceptions import ErrorNotSupported, ErrorParameterOutOfRange
from .types import (
    FmcwElementType,
    FmcwMetrics,
    FmcwSequenceChirp,
    FmcwSequenceElement,
    FmcwSequenceLoop,
    FmcwSimpleSequenceConfig,
    Link,
)

SPEED_OF_LIGHT_M_PER_S = 299_792_458.0
#: Time that the chip needs in each chirp beside its samples, s, as in ``dsp/src/waveform.rs``.
CHIRP_OVERHEAD_S = 8.0e-6
#: Step of chirp intervals, s: a shortest interval must not be rounded down.
CHIRP_INTERVAL_STEP_S = 1e-7


def simple_sequence(config: FmcwSimpleSequenceConfig) -> FmcwSequenceElement:
    """Loop over frames around a loop over chirps around the chirp."""
    if config.tdm_mimo:
        raise ErrorNotSupported("tdm_mimo needs two transmitters, the BGT60TR13C has one", "set tdm_mimo=False")
    chirp = FmcwSequenceElement(type=FmcwElementType.IFX_SEQ_CHIRP, chirp=FmcwSequenceChirp(**config.chirp.to_dict()))
    chirps = FmcwSequenceLoop(Link(chirp), config.num_chirps, config.chirp_repetition_time_s)
    frames = FmcwSequenceLoop(Link(FmcwSequenceElement(loop=chirps)), 0, config.frame_repetition_time_s)
    return FmcwSequenceElement(loop=frames)


def parts(sequence: FmcwSequenceElement) -> Tuple[FmcwSequenceLoop, FmcwSequenceLoop, FmcwSequenceChirp]:
    """Loop over frames, loop over chirps, and the chirp."""
    frames = sequence.loop
    inner = frames.sub_sequence.contents
    chirp = None if inner is None else inner.loop.sub_sequence.contents
    loops = (sequence, inner)
    is_simple = chirp is not None and all(
        e is not None and e.type == FmcwElementType.IFX_SEQ_LOOP and not e.next_element for e in loops
    )
    if not is_simple or chirp is None or chirp.type != FmcwElementType.IFX_SEQ_CHIRP or chirp.next_element:
        raise ErrorNotSupported(
            "the sequence is not a loop over frames around a loop over chirps around one chirp",
            "make it by create_simple_sequence",
        )
    assert inner is not None
    return frames, inner.loop, chirp.chirp


def shortest_chirp_s(num_samples: int, sample_rate_hz: float) -> float:
    """Shortest chirp interval, s."""
    if sample_rate_hz <= 0.0:
        raise ErrorParameterOutOfRange(f"sample_rate_Hz is {sample_rate_hz}, expected a number above 0")
    return num_samples / sample_rate_hz + CHIRP_OVERHEAD_S + CHIRP_INTERVAL_STEP_S


def waveform(sequence: FmcwSequenceElement) -> Waveform:
    """Waveform of a sequence. Intervals of 0 are the shortest that there can be."""
    frames, chirps, chirp = parts(sequence)
    return waveform_of_chirp(chirp, chirps.num_repetitions, chirps.repetition_time_s, frames.repetition_time_s)


def waveform_of_chirp(chirp: FmcwSequenceChirp, num_chirps: int, chirp_s: float, frame_s: float) -> Waveform:
    """Waveform of chirps at these intervals, s."""
    if chirp.rx_mask & ~0b111:
        raise ErrorParameterOutOfRange(f"rx_mask is {chirp.rx_mask:#b}, the BGT60TR13C has three receivers")
    chirp_s = chirp_s if chirp_s > 0.0 else shortest_chirp_s(chirp.num_samples, chirp.sample_rate_Hz)
    frame_s = frame_s if frame_s > 0.0 else num_chirps * (chirp_s + CHIRP_INTERVAL_STEP_S)
    try:
        return Waveform(
            start_frequency_hz=float(chirp.start_frequency_Hz),
            end_frequency_hz=float(chirp.end_frequency_Hz),
            samples_per_chirp=int(chirp.num_samples),
            chirps_per_frame=int(num_chirps),
            sample_rate_hz=float(chirp.sample_rate_Hz),
            chirp_interval_s=float(chirp_s),
            frame_interval_s=float(frame_s),
            rx_antennas=[antenna + 1 for antenna in range(3) if chirp.rx_mask >> antenna & 1],
            tx_power_level=int(chirp.tx_power_level),
            if_gain_db=float(chirp.if_gain_dB),
            high_pass_cutoff_hz=float(chirp.hp_cutoff_Hz),
            anti_alias_cutoff_hz=float(chirp.lp_cutoff_Hz),
        )
    except RadomeError as error:
        raise ErrorParameterOutOfRange(error.message, error.hint) from error


def sequence_of(wave: Waveform) -> FmcwSequenceElement:
    """Sequence of a waveform."""
    request = wave.request
    chirp = FmcwSequenceChirp(
        start_frequency_Hz=request["start_frequency_hz"],
        end_frequency_Hz=request["end_frequency_hz"],
        sample_rate_Hz=request["sample_rate_hz"],
        num_samples=request["samples_per_chirp"],
        rx_mask=sum(1 << (antenna - 1) for antenna in request["rx_antennas"]),
        tx_mask=1,
        tx_power_level=request["tx_power_level"],
        lp_cutoff_Hz=int(request["anti_alias_cutoff_hz"]),
        hp_cutoff_Hz=int(request["high_pass_cutoff_hz"]),
        if_gain_dB=int(request["if_gain_db"]),
    )
    return simple_sequence(
        FmcwSimpleSequenceConfig(
            frame_repetition_time_s=request["frame_interval_s"],
            chirp_repetition_time_s=request["chirp_interval_s"],
            num_chirps=request["chirps_per_frame"],
            chirp=chirp,
        )
    )


def lone_chirp(chirp: FmcwSequenceChirp) -> Waveform:
    """Waveform of a chirp alone, for what its ramp and its samples decide."""
    return waveform_of_chirp(chirp, 1, 0.0, 0.0)


def metrics(chirp_loop: FmcwSequenceElement) -> FmcwMetrics:
    """Resolutions and limits of a loop over chirps, by the band that is sampled."""
    _, chirps, chirp = parts(FmcwSequenceElement(loop=FmcwSequenceLoop(Link(chirp_loop))))
    wave = waveform_of_chirp(chirp, chirps.num_repetitions, chirps.repetition_time_s, 0.0)
    return FmcwMetrics(
        range_resolution_m=wave.range_resolution_m,
        max_range_m=wave.max_range_m,
        max_speed_m_s=wave.max_velocity_m_per_s,
        speed_resolution_m_s=2.0 * wave.max_velocity_m_per_s / chirps.num_repetitions,
        center_frequency_Hz=wave.centre_frequency_hz,
    )


def apply_metrics(wanted: FmcwMetrics, chirp_loop: FmcwSequenceElement, round_to_power_of_2: bool) -> None:
    """Band, samples, chirps and chirp interval of a loop over chirps, by metrics. The band is the one requested; the one
    that is sampled is a little narrower. Speeds of 0 ask for one chirp."""
    _, chirps, chirp = parts(FmcwSequenceElement(loop=FmcwSequenceLoop(Link(chirp_loop))))
    if wanted.range_resolution_m <= 0.0 or wanted.max_range_m <= 0.0:
        raise ErrorParameterOutOfRange("range_resolution_m and max_range_m must be above 0")
    bandwidth_hz = SPEED_OF_LIGHT_M_PER_S / (2.0 * wanted.range_resolution_m)
    chirp.start_frequency_Hz = wanted.center_frequency_Hz - 0.5 * bandwidth_hz
    chirp.end_frequency_Hz = wanted.center_frequency_Hz + 0.5 * bandwidth_hz

    def count(number: float) -> int:
        return 1 << max(0, math.ceil(math.log2(number) - 1e-9)) if round_to_power_of_2 else math.ceil(number - 1e-9)

    chirp.num_samples = count(2.0 * wanted.max_range_m / wanted.range_resolution_m)
    if wanted.max_speed_m_s > 0.0 and wanted.speed_resolution_m_s > 0.0:
        wavelength_m = SPEED_OF_LIGHT_M_PER_S / wanted.center_frequency_Hz
        chirps.num_repetitions = count(2.0 * wanted.max_speed_m_s / wanted.speed_resolution_m_s)
        chirps.repetition_time_s = wavelength_m / (4.0 * wanted.max_speed_m_s)
    else:
        chirps.num_repetitions, chirps.repetition_time_s = 1, 0.0
