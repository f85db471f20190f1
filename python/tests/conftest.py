"""Sources and files that the tests share."""

import json
from pathlib import Path

import numpy as np
import pytest

import radome

ROOT = Path(__file__).resolve().parents[2]
FIXTURES = ROOT / "fixtures"
#: 3 receivers, 8 chirps, 64 samples: a frame takes milliseconds.
DESK = FIXTURES / "scenes" / "desk.toml"
#: The waveform of the shipped room models.
ROOM = FIXTURES / "scenes" / "rooms-still.toml"

#: Maps of one receiver, as networks take them.
SPEC = {"channels": {"one": 0}, "static_removal": "slow_time_mean"}


@pytest.fixture(scope="session")
def desk_frames():
    """Ten frames of one person at a desk."""
    with radome.simulate(DESK, frames=10, seed=3, people=1) as source:
        return list(source)


@pytest.fixture
def recording(tmp_path, desk_frames):
    """A recording of those frames without the fourth and the fifth, with a gap and two labels."""
    path = tmp_path / "desk.mcap"
    with radome.Recorder(path, desk_frames[0].waveform) as recorder:
        for frame in desk_frames[:3]:
            recorder.write(frame)
        recorder.write(radome.Gap(3, 2, "packet_lost"))
        for frame in desk_frames[5:]:
            recorder.write(frame)
        middle_s = desk_frames[7].time_s
        recorder.write(radome.Label(0.0, middle_s, "one", who="me"))
        recorder.write(radome.Label(middle_s, middle_s + 10.0, "empty"))
    return path


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory):
    """Four sequences of four maps of each class."""
    path = tmp_path_factory.mktemp("dataset") / "desk"
    waveform = radome.Waveform(**scene_waveform(DESK))
    with radome.DatasetWriter(path, waveform, SPEC) as writer:
        for people, label in enumerate(radome.CLASSES):
            for seed in range(4):
                with radome.simulate(DESK, frames=4, seed=seed, people=people) as source:
                    for frame in source:
                        writer.add(radome.rdm(frame, SPEC), label, sequence=f"{label} {seed}", domain="sim", scene="desk")
    return path


def scene_waveform(scene):
    with radome.simulate(scene, frames=1, people=0) as source:
        return source.waveform.request


def reference_map(codes):
    """The default map of codes by its definition, in float64: dB of ``[rx][doppler][range]``."""
    rx, chirps, samples = codes.shape

    def hann(length):
        return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)

    fast, slow = hann(samples), hann(chirps)
    x = (codes.astype(np.float64) - 2048.0) / 2048.0
    spectrum = np.fft.rfft(x * fast, axis=2)[:, :, : samples // 2]
    spectrum = np.fft.fftshift(np.fft.fft(spectrum * slow[None, :, None], axis=1), axes=1)
    scale = np.full(samples // 2, 2.0)
    scale[0] = 1.0
    amplitude = np.abs(spectrum) * scale / (fast.sum() * slow.sum())
    return 20.0 * np.log10(np.maximum(amplitude, 1e-10))


@pytest.fixture(scope="session")
def circuit_points():
    """Points of the paper's circuit, computed by Qiskit."""
    return json.loads((FIXTURES / "circuit" / "qiskit_pqc.json").read_text())["reps"]["1"]["points"]
