"""Range-Doppler maps."""

import gc

import numpy as np
import pytest

import radome
from conftest import reference_map


def test_a_map_is_that_of_its_definition(desk_frames):
    for frame in desk_frames[:3]:
        map = radome.rdm(frame)
        expected = reference_map(frame.codes)
        assert map.db.shape == map.shape == expected.shape == (3, 8, 32)
        amplitude = 10.0 ** (map.db.astype(np.float64) / 20.0)
        assert amplitude.max() > 1e-3
        assert np.abs(amplitude - 10.0 ** (expected / 20.0)).max() < 1e-6


def test_axes_are_those_of_the_sampled_band(desk_frames):
    frame = desk_frames[0]
    map = radome.rdm(frame)
    assert map.range_m[1] == pytest.approx(frame.waveform.range_resolution_m)
    assert map.velocity_m_per_s[4] == 0.0
    assert map.velocity_m_per_s[0] == pytest.approx(-frame.waveform.max_velocity_m_per_s)


def test_a_moving_target_is_where_it_is():
    waveform = radome.Waveform.load("paper")
    rx, chirps, samples = waveform.shape
    range_m, velocity_m_per_s = 4.0, 1.1
    time_s = np.arange(samples) / waveform.sample_rate_hz
    distance_m = range_m + velocity_m_per_s * np.arange(chirps) * waveform.chirp_interval_s
    delay_s = 2.0 * distance_m / 299_792_458.0
    start_hz = waveform.centre_frequency_hz - 0.5 * waveform.sampled_bandwidth_hz
    phase = start_hz * delay_s[:, None] + waveform.slope_hz_per_s * delay_s[:, None] * time_s
    codes = np.round(2048.0 + 900.0 * np.cos(2.0 * np.pi * phase)).astype(np.uint16)
    frame = radome.Frame.from_array(np.broadcast_to(codes, (rx, chirps, samples)), waveform)
    map = radome.rdm(frame)
    _, doppler, bin = np.unravel_index(map.db.argmax(), map.db.shape)
    assert map.range_m[bin] == pytest.approx(range_m, abs=map.range_m[1])
    assert map.velocity_m_per_s[doppler] == pytest.approx(velocity_m_per_s, abs=np.diff(map.velocity_m_per_s)[0])


def test_presets_and_specs_are_taken(desk_frames):
    frame = desk_frames[0]
    assert radome.rdm(frame, "paper").shape == (1, 8, 32)
    assert radome.rdm(frame, "sdk").shape == (3, 16, 64)
    summed = radome.rdm(frame, {"channels": "incoherent_sum"}).db[0]
    power = 10.0 ** (radome.rdm(frame).db.astype(np.float64) / 10.0)
    assert np.allclose(10.0 ** (summed.astype(np.float64) / 10.0), power.mean(axis=0), rtol=1e-3, atol=1e-12)


def test_maps_have_the_motion_of_echoes_if_asked_for(desk_frames):
    waveform = desk_frames[0].waveform
    assert radome.rdm(desk_frames[0]).motion is None
    processor = radome.MapProcessor(waveform, {"channels": {"one": 0}, "motion_over_s": 1.0})
    motions = [processor(frame).motion for frame in desk_frames]
    quantities = [
        "spacing_change_rad",
        "shift_error_m",
        "nearest_error_m",
        "separation_change_m",
        "second_share",
        "velocity_difference_m_per_s",
        "nearer_change",
    ]
    assert all(list(motion) == quantities for motion in motions)
    # The first frame has none to be compared with.
    assert [motions[0][key] for key in quantities[:4]] == [0.0] * 4
    assert all(0.0 <= value < 10.0 for motion in motions for value in motion.values())
    with pytest.raises(radome.RadomeError, match="motion_over_s needs maps of one channel"):
        radome.MapProcessor(waveform, {"motion_over_s": 1.0})


def test_a_processor_keeps_its_window_over_frames(desk_frames):
    processor = radome.MapProcessor(desk_frames[0].waveform, {"slow_time": {"frames": {"frames": 4}}})
    maps = [processor(frame) for frame in desk_frames[:5]]
    assert [map is None for map in maps] == [True] * 3 + [False] * 2
    processor.reset()
    assert processor(desk_frames[5]) is None


class TestHardCases:
    def test_a_map_is_kept_beyond_its_frame(self, desk_frames):
        cells = radome.rdm(radome.Frame.from_array(desk_frames[0].codes.copy(), desk_frames[0].waveform)).db
        gc.collect()
        assert np.array_equal(cells, radome.rdm(desk_frames[0]).db)
        with pytest.raises(ValueError):
            cells[0, 0, 0] = 0.0

    @pytest.mark.parametrize("dtype", [">u2", "<i4", "u8", ">i8"])
    def test_integers_of_any_kind_are_codes(self, desk_frames, dtype):
        frame = desk_frames[0]
        other = radome.Frame.from_array(frame.codes.astype(dtype), frame.waveform)
        assert np.array_equal(other.codes, frame.codes)

    def test_arrays_that_are_not_contiguous_are_codes(self, desk_frames):
        frame = desk_frames[0]
        wide = np.zeros((3, 8, 128), dtype=np.uint16)
        wide[:, :, ::2] = frame.codes
        fortran = np.asfortranarray(frame.codes)
        backwards = frame.codes[:, ::-1, :].copy()[:, ::-1, :]
        for array in (wide[:, :, ::2], fortran, backwards):
            assert not array.flags["C_CONTIGUOUS"]
            assert np.array_equal(radome.Frame.from_array(array, frame.waveform).codes, frame.codes)

    def test_what_cannot_be_codes_is_refused(self, desk_frames):
        frame = desk_frames[0]
        with pytest.raises(radome.ArrayTypeError, match="float64") as error:
            radome.Frame.from_array(frame.codes.astype(float), frame.waveform)
        assert isinstance(error.value, TypeError) and "4095" in error.value.hint
        with pytest.raises(radome.ArrayValueError, match="shape"):
            radome.Frame.from_array(frame.codes[:2], frame.waveform)
        for code in (-1, 4096):
            codes = frame.codes.astype(np.int32)
            codes[0, 0, 0] = code
            with pytest.raises(radome.ArrayValueError, match=str(code)):
                radome.Frame.from_array(codes, frame.waveform)
        with pytest.raises(TypeError):
            radome.rdm(frame.codes)

    def test_unknown_specs_name_what_is_known(self, desk_frames):
        with pytest.raises(radome.RadomeError) as error:
            radome.rdm(desk_frames[0], "house")
        assert "'paper'" in error.value.hint
        with pytest.raises(radome.RadomeError, match="colour"):
            radome.rdm(desk_frames[0], {"colour": 1})
        with pytest.raises(radome.RadomeError, match="MapProcessor"):
            radome.rdm(desk_frames[0], {"slow_time": {"frames": {"frames": 4}}})
