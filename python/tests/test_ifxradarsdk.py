"""Scripts that were written for the vendor's Python SDK."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest

import radome
from conftest import DESK
from radome.ifxradarsdk import get_version_full
from radome.ifxradarsdk.common.common_types import RadarSensor
from radome.ifxradarsdk.common.exceptions import (
    EndOfFrames,
    ErrorNoDevice,
    ErrorNotSupported,
    ErrorParameterOutOfRange,
    ErrorTimeout,
    GeneralError,
)
from radome.ifxradarsdk.fmcw import DeviceFmcw
from radome.ifxradarsdk.fmcw.types import (
    FmcwMetrics,
    FmcwSequenceChirp,
    FmcwSimpleSequenceConfig,
    create_dict_from_sequence,
)


def configuration(**changes):
    chirp = dict(
        start_frequency_Hz=59e9,
        end_frequency_Hz=61e9,
        sample_rate_Hz=2e6,
        num_samples=128,
        rx_mask=5,
        tx_mask=1,
        tx_power_level=31,
        lp_cutoff_Hz=500000,
        hp_cutoff_Hz=80000,
        if_gain_dB=30,
    )
    return FmcwSimpleSequenceConfig(
        frame_repetition_time_s=0.1,
        chirp_repetition_time_s=500e-6,
        num_chirps=16,
        tdm_mimo=False,
        chirp=FmcwSequenceChirp(**{**chirp, **changes}),
    )


def test_a_device_measures_what_it_is_told():
    with DeviceFmcw(port=f"emulated:{DESK}") as device:
        assert len(device.get_board_uuid()) == 36 and str(device.get_sensor_type()) == "RadarSensor.BGT60TR13C"
        assert device.get_firmware_information()["version_major"] >= 0
        sequence = device.create_simple_sequence(configuration())
        device.set_acquisition_sequence(sequence)
        device.start_acquisition()
        frames = [device.get_next_frame() for _ in range(3)]
        device.stop_acquisition()
    for contents in frames:
        (cube,) = contents
        assert cube.shape == (2, 16, 128) and cube.dtype == np.float32
        assert np.abs(cube).max() <= 1.0 and cube.std() > 0.0


def test_a_device_is_closed_behind_its_with_block(recording):
    with DeviceFmcw(port=str(recording)) as device:
        device.get_next_frame()
    for use in (device.get_next_frame, device.start_acquisition):
        with pytest.raises(ErrorNoDevice, match="closed"):
            use()
    device.stop_acquisition()


def test_frames_of_a_recording_are_its_codes(recording, desk_frames):
    with DeviceFmcw(port=str(recording)) as device:
        cube = device.get_next_frame()[0]
        assert np.abs(cube - (2.0 * desk_frames[0].codes / 4095.0 - 1.0)).max() < 1e-6
        for _ in range(7):
            device.get_next_frame(timeout_ms=60_000)
        assert device.frames_lost == 2
        with pytest.raises(EndOfFrames):
            device.get_next_frame()
        # The recording's own waveform, as a sequence, and a device that begins anew.
        device.set_acquisition_sequence(device.get_acquisition_sequence())
        assert np.array_equal(device.get_next_frame()[0], cube)


def test_a_board_is_found_by_its_uuid(monkeypatch):
    """As scripts for two boards name them."""
    here = f"emulated:{DESK}"
    with DeviceFmcw(port=here) as device:
        uuid = device.get_board_uuid()
    monkeypatch.delenv("RADOME_SOURCE", raising=False)
    monkeypatch.setattr("radome.ifxradarsdk.fmcw.fmcw.boards", lambda: [("serial:/dev/none", {}), (here, {})])
    with DeviceFmcw(uuid=uuid.upper()) as device:
        assert device.get_board_uuid() == uuid
    other = "00323253-4335-4851-3036-303439303531"
    with pytest.raises(ErrorNoDevice, match=other):
        DeviceFmcw(uuid=other)
    # The variable stands for the board that a script was written for.
    monkeypatch.setenv("RADOME_SOURCE", here)
    with DeviceFmcw(uuid=other) as device:
        assert device.get_next_frame()[0].ndim == 3


def test_sequences_and_metrics_describe_each_other():
    device = DeviceFmcw(sensor_type=RadarSensor.BGT60TR13C)
    wanted = FmcwMetrics(
        range_resolution_m=0.15, max_range_m=4.8, max_speed_m_s=2.45, speed_resolution_m_s=0.2,
        center_frequency_Hz=60_750_000_000,
    )
    sequence = device.create_simple_sequence(FmcwSimpleSequenceConfig())
    sequence.loop.repetition_time_s = 0.2
    chirp_loop = sequence.loop.sub_sequence.contents
    device.sequence_from_metrics(wanted, chirp_loop)
    chirp = chirp_loop.loop.sub_sequence.contents.chirp
    chirp.sample_rate_Hz = 1_000_000
    chirp.rx_mask = (1 << device.get_sensor_information()["num_rx_antennas"]) - 1
    chirp.tx_mask, chirp.tx_power_level, chirp.if_gain_dB = 1, 31, 33
    chirp.lp_cutoff_Hz, chirp.hp_cutoff_Hz = 500000, 80000
    assert chirp.num_samples == 64 and chirp_loop.loop.num_repetitions == 32
    device.set_acquisition_sequence(sequence)
    found = device.metrics_from_sequence(chirp_loop)
    # The sampled band is a little narrower than the one requested.
    assert 0.15 < found.range_resolution_m < 0.16
    assert found.max_speed_m_s == pytest.approx(2.45, rel=0.01)
    assert device.get_chirp_sampling_bandwidth(chirp) == pytest.approx(299792458.0 / (2 * found.range_resolution_m))
    assert device.get_minimum_chirp_repetition_time(64, 1e6) == pytest.approx(72e-6, abs=1e-6)
    printed = create_dict_from_sequence(device.get_acquisition_sequence())
    assert printed[0]["loop"]["sub_sequence"][0]["loop"]["sub_sequence"][0]["chirp"]["num_samples"] == 64
    assert device.get_sequence_duration(chirp_loop) == pytest.approx(32 * chirp_loop.loop.repetition_time_s)


def test_registers_are_written(tmp_path):
    device = DeviceFmcw(sensor_type=RadarSensor.BGT60TR13C)
    device.set_acquisition_sequence(device.create_simple_sequence(configuration()))
    device.save_register_file(str(tmp_path / "registers.txt"))
    lines = (tmp_path / "registers.txt").read_text().splitlines()
    assert any(line.startswith("MAIN 0x00 0x") for line in lines) and len(lines) > 10


def test_a_script_runs_with_its_imports_changed(recording):
    """As a user's script: the source is named from outside."""
    script = """
        import pprint
        from radome.ifxradarsdk import get_version
        from radome.ifxradarsdk.fmcw import DeviceFmcw
        from radome.ifxradarsdk.fmcw.types import FmcwSimpleSequenceConfig, FmcwSequenceChirp

        print("version", get_version(), DeviceFmcw.get_list())
        with DeviceFmcw() as device:
            print("uuid", device.get_board_uuid(), str(device.get_sensor_type()))
            for number in range(3):
                for frame in device.get_next_frame():
                    print("frame", number, frame.shape)
    """
    environment = {**os.environ, "RADOME_SOURCE": str(recording)}
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.count("(3, 8, 64)") == 3 and str(recording) in done.stdout
    assert get_version_full() == f"radome {radome.__version__}"


class TestHardCases:
    def test_what_the_chip_cannot_do_is_refused(self):
        device = DeviceFmcw(sensor_type=RadarSensor.BGT60TR13C)
        with pytest.raises(ErrorParameterOutOfRange, match="sample_rate_hz"):
            device.set_acquisition_sequence(device.create_simple_sequence(configuration(sample_rate_Hz=100e6)))
        with pytest.raises(ErrorParameterOutOfRange, match="rx_mask"):
            device.set_acquisition_sequence(device.create_simple_sequence(configuration(rx_mask=15)))
        with pytest.raises(ErrorNotSupported):
            device.create_simple_sequence(FmcwSimpleSequenceConfig(tdm_mimo=True))
        with pytest.raises(ErrorNotSupported):
            device.load_register_file("registers.txt")
        with pytest.raises(ErrorNoDevice):
            device.get_next_frame()
        with pytest.raises(ErrorNotSupported):
            DeviceFmcw(sensor_type=RadarSensor.Unknown_sensor)

    def test_a_temperature_that_is_not_known_is_not_made_up(self, recording):
        with DeviceFmcw(port=str(recording)) as device:
            device.get_next_frame()
            with pytest.warns(RuntimeWarning, match="temperature"):
                assert np.isnan(device.get_temperature())

    def test_errors_are_of_the_vendors_base_class(self, monkeypatch, recording):
        monkeypatch.setenv("RADOME_SPEED", "1e-6")
        with DeviceFmcw(port=str(recording)) as device:
            device.get_next_frame()
            with pytest.raises(ErrorTimeout) as error:
                device.get_next_frame(timeout_ms=50)
        assert isinstance(error.value, GeneralError) and isinstance(error.value, radome.RadomeError)
        with pytest.raises(FileNotFoundError):
            DeviceFmcw(port="/nowhere/none.mcap").start_acquisition()
