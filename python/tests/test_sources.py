"""Frames of simulations, recordings and emulated boards."""

import errno
import gc
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

import radome
from conftest import DESK, FIXTURES


def test_a_seed_gives_the_same_frames_and_another_others(desk_frames):
    with radome.simulate(DESK, frames=10, seed=3, people=1) as source:
        again = list(source)
    with radome.simulate(DESK, frames=1, seed=4, people=1) as source:
        other = next(source)
    assert [frame.sequence for frame in again] == list(range(10))
    assert all(np.array_equal(a.codes, b.codes) for a, b in zip(desk_frames, again))
    assert not np.array_equal(desk_frames[0].codes, other.codes)
    assert {frame.truth for frame in again} == {"one"}


def test_a_frame_is_what_its_waveform_says(desk_frames):
    frame = desk_frames[1]
    assert frame.codes.shape == frame.shape == frame.waveform.shape == (3, 8, 64)
    assert frame.codes.dtype == np.uint16 and frame.codes.max() <= 4095
    assert frame.time_s == pytest.approx(frame.waveform.frame_interval_s, rel=1e-6)
    assert frame.has_signal and frame.temperature_c is None


def test_codes_are_one_memory_that_cannot_be_written_to(desk_frames):
    codes = desk_frames[0].codes
    assert np.shares_memory(codes, desk_frames[0].codes)
    with pytest.raises(ValueError):
        codes[0, 0, 0] = 1
    with pytest.raises(ValueError):
        codes.flags.writeable = True


def test_a_recording_gives_back_frames_gaps_and_labels(recording, desk_frames):
    with radome.open(recording) as source:
        events = list(source.events())
        labels = [source.label_of(event) for event in events if isinstance(event, radome.Frame)]
        assert source.labels[0].who == "me"
        assert source.frames_lost == 2 and source.gaps == [radome.Gap(3, 2, "packet_lost")]
    assert [type(event).__name__ for event in events] == ["Frame"] * 3 + ["Gap"] + ["Frame"] * 5
    frames = [event for event in events if isinstance(event, radome.Frame)]
    kept = desk_frames[:3] + desk_frames[5:]
    assert [frame.sequence for frame in frames] == [frame.sequence for frame in kept]
    assert all(np.array_equal(a.codes, b.codes) for a, b in zip(frames, kept))
    assert labels == ["one"] * 5 + ["empty"] * 3


def test_an_emulated_board_gives_the_frames_of_its_scene(desk_frames):
    with radome.open(f"emulated:{DESK}", frames=10, seed=3, people=1) as source:
        frames = list(source)
        assert source.board["chip"] == "BGT60TR13C"
    assert [frame.sequence for frame in frames] == list(range(10))
    assert all(np.array_equal(a.codes, b.codes) for a, b in zip(frames, desk_frames))
    assert all(frame.truth == "one" for frame in frames)


def test_formats_of_the_vendor_are_written_and_read(tmp_path, desk_frames):
    for name in ["desk.txt", "desk"]:
        with radome.Recorder(tmp_path / name, desk_frames[0].waveform) as recorder:
            for frame in desk_frames:
                recorder.write(frame)
        assert recorder.report["frames"] == 10 and recorder.report["omitted"]
        with radome.open(tmp_path / name) as source:
            assert all(np.array_equal(a.codes, b.codes) for a, b in zip(source, desk_frames))


def test_a_recording_that_fails_leaves_no_file(tmp_path, desk_frames):
    path = tmp_path / "half.mcap"
    with pytest.raises(RuntimeError):
        with radome.Recorder(path, desk_frames[0].waveform) as recorder:
            recorder.write(desk_frames[0])
            raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_public_names_have_docstrings():
    for name in set(radome.__all__) - {"CLASSES"}:
        assert getattr(radome, name).__doc__, name
    for preset in ("default", "paper", "sdk"):
        assert f'"{preset}"' in radome.rdm.__doc__
    for key in radome.MapProcessor(radome.Waveform.load("paper")).spec:
        assert f"`{key}`" in radome.rdm.__doc__, key


def test_importing_does_not_import_numpy():
    """Two thirds of the import's time would be NumPy's."""
    code = "import radome, sys; assert not {'numpy', 'torch'} & set(sys.modules), 'imported'"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_waveforms_change_and_travel(desk_frames):
    waveform = desk_frames[0].waveform
    other = waveform.replace(samples_per_chirp=32)
    assert other.shape == (3, 8, 32) and other != waveform
    assert pickle.loads(pickle.dumps(waveform)) == waveform
    assert radome.Waveform.load("paper").shape == (3, 128, 256)
    assert radome.Waveform.load("room-hqnn") == radome.Model("room-hqnn").waveform
    assert any(name == "MAIN" for name, _, _ in waveform.registers())
    with radome.open(DESK, waveform=other, frames=1) as source:
        assert next(source).shape == (3, 8, 32)


def test_paths_lie_on_their_lengths():
    found = radome.paths(FIXTURES / "scenes" / "corridor.toml", people=0, margin_db=40.0)
    assert len(found) > 10 and {path.kind for path in found} == {"walls", "furniture"}
    for path in found:
        corners = np.array(path.points_m)
        length_m = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        assert length_m == pytest.approx(path.length_m, abs=1e-6)
        assert path.delay_s == pytest.approx(path.length_m / 299_792_458.0, rel=1e-12)


def test_people_are_listed_for_each_frame_and_move_at_their_velocity():
    listed = radome.people(FIXTURES / "scenes" / "corridor.toml", frames=120, seed=7, people=2)
    assert {person.person for person in listed} <= {0, 1} and listed[-1].sequence == 119
    by_frame = {(person.sequence, person.person): person for person in listed}
    compared = 0
    for (sequence, number), before in by_frame.items():
        after = by_frame.get((sequence + 1, number))
        if after is not None:
            rate = (after.range_m - before.range_m) / (after.time_s - before.time_s)
            mean = 0.5 * (before.radial_velocity_m_per_s + after.radial_velocity_m_per_s)
            assert abs(rate - mean) < 0.15
            compared += 1
    assert compared > 20
    with pytest.raises(radome.RadomeError):
        radome.people(FIXTURES / "scenes" / "corridor.toml", frames=1, people=70)


class TestHardCases:
    def test_a_frame_is_kept_beyond_its_source(self, desk_frames):
        source = radome.simulate(DESK, frames=3, seed=3, people=1)
        codes = [frame.codes for frame in source]
        source.close()
        del source
        gc.collect()
        assert all(np.array_equal(a, b.codes) for a, b in zip(codes, desk_frames))

    def test_a_closed_source_says_so(self):
        source = radome.simulate(DESK, frames=3)
        source.close()
        source.close()
        with pytest.raises(radome.RadomeError, match="closed"):
            next(source)

    def test_a_source_at_its_end_stays_there(self):
        with radome.simulate(DESK, frames=2, people=0) as source:
            assert len(list(source)) == 2
            assert list(source) == [] and source.next_frame() is None

    @pytest.mark.parametrize("kind", ["{}", "emulated:{}"])
    def test_every_source_ends_after_so_many_frames(self, recording, kind):
        for path in (recording, DESK):
            with radome.open(kind.format(path), frames=4) as source:
                assert source.frame_count in (4, None)
                assert len(list(source)) == 4 and source.next_frame() is None
        # The recording has a gap behind its third frame, which is no frame.
        with radome.open(recording, frames=4) as source:
            assert [frame.sequence for frame in source] == [0, 1, 2, 5] and source.frames_lost == 2
        with radome.open(recording, frames=100) as source:
            assert source.frame_count == 8 and len(list(source)) == 8
        with radome.open(recording, frames=0) as source:
            assert list(source) == []

    @pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
    @pytest.mark.parametrize("name", ["speed", "give_up_after_s"])
    def test_times_and_speeds_that_cannot_be_are_refused(self, recording, name, value):
        with pytest.raises(ValueError, match=name):
            radome.open(recording, **{name: value})

    def test_two_threads_share_a_source(self):
        seen = []
        with radome.simulate(DESK, frames=60, people=0) as source:
            threads = [threading.Thread(target=lambda: seen.extend(f.sequence for f in source)) for _ in range(2)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60.0)
        assert sorted(seen) == list(range(60))

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
    @pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
    def test_a_fork_is_told_that_the_source_is_not_its_own(self, recording):
        with radome.open(recording) as source, radome.simulate(DESK, frames=50) as simulation:
            next(simulation)
            child = os.fork()
            if child == 0:
                code = 1
                try:
                    for of_parent in (source, simulation):
                        with pytest.raises(radome.RadomeError, match="fork") as error:
                            next(of_parent)
                        assert "spawn" in error.value.hint
                        of_parent.close()
                    # What the child opens itself is its own.
                    with radome.open(recording) as own:
                        assert len(list(own)) == 8
                    code = 0
                finally:
                    os._exit(code)
            _, status = os.waitpid(child, 0)
            assert os.waitstatus_to_exitcode(status) == 0
            assert next(source).sequence == 0

    def test_a_wait_ends_in_time(self):
        with radome.open(DESK, frames=2, speed=1e-6) as source:
            next(source)
            with pytest.raises(TimeoutError):
                source.next_frame(timeout_s=0.1)

    @pytest.mark.parametrize("source", [str(DESK), f"emulated:{DESK}"])
    def test_ctrl_c_ends_the_wait_for_a_frame(self, source):
        script = f"""
            import radome
            with radome.open({source!r}, frames=2, speed=1e-6) as source:
                try:
                    print("waiting", flush=True)
                    list(source)
                except KeyboardInterrupt:
                    print("interrupted", flush=True)
        """
        command = [sys.executable, "-c", textwrap.dedent(script)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline() == "waiting\n"
            # By then it waits; if it does not, the signal comes before the wait.
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            assert process.communicate(timeout=60)[0] == "interrupted\n"
            assert process.returncode == 0

    @pytest.mark.skipif(not hasattr(os, "openpty"), reason="the system has no pseudo-terminals")
    def test_ctrl_c_ends_the_wait_for_a_board_that_says_nothing(self):
        ours, port = os.openpty()
        script = f"""
            import radome
            print("waiting", flush=True)
            try:
                radome.open("serial:{os.ttyname(port)}")
            except KeyboardInterrupt:
                print("interrupted", flush=True)
        """
        command = [sys.executable, "-c", textwrap.dedent(script)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline() == "waiting\n"
            # The first request of the handshake: from here on an answer is waited for.
            assert os.read(ours, 1)
            process.send_signal(signal.SIGINT)
            assert process.communicate(timeout=60)[0] == "interrupted\n"
            assert process.returncode == 0
        os.close(ours)
        os.close(port)

    def test_a_missing_file_is_pythons_own_error(self, tmp_path):
        with pytest.raises(FileNotFoundError) as error:
            radome.open(tmp_path / "none.mcap")
        assert isinstance(error.value, radome.RadomeError) and error.value.errno == errno.ENOENT
        with pytest.raises(OSError):
            radome.open(f"serial:{tmp_path}/none")

    def test_a_waveform_is_named_by_any_path(self, tmp_path, recording, desk_frames):
        assert radome.Waveform.load(recording) == desk_frames[0].waveform
        with radome.open(DESK, waveform=recording, frames=1) as source:
            assert next(source).shape == (3, 8, 64)
        with pytest.raises(TypeError):
            radome.Waveform.load(3)

    def test_errors_of_files_name_the_file(self, tmp_path):
        for read in (radome.Waveform.load, radome.read_labels, lambda path: radome.open(DESK, waveform=path)):
            with pytest.raises(FileNotFoundError, match="none.toml|none.txt"):
                read(tmp_path / ("none.txt" if read is radome.read_labels else "none.toml"))

    def test_an_error_has_hint_and_cause(self, tmp_path):
        scene = tmp_path / "bad.toml"
        scene.write_text("format = 1\n")
        with pytest.raises(radome.RadomeError, match="bad.toml"):
            radome.simulate(scene)
        with pytest.raises(radome.RadomeError) as error:
            radome.simulate(tmp_path / "scene.json")
        assert error.value.hint is not None and error.value.hint in str(error.value)
        with pytest.raises(FileNotFoundError) as missing:
            radome.Model(tmp_path / "none.safetensors")
        assert missing.value.__cause__ is not None

    def test_a_recording_is_not_replaced_unless_asked(self, recording, desk_frames):
        with pytest.raises(FileExistsError):
            radome.Recorder(recording, desk_frames[0].waveform)

    def test_frames_that_are_left_out_are_a_gap(self, tmp_path, desk_frames):
        path = tmp_path / "some.mcap"
        with radome.Recorder(path, desk_frames[0].waveform) as recorder:
            for frame in desk_frames[2:4] + desk_frames[6:8]:
                recorder.write(frame)
            # A gap of unknown length is not counted twice.
            recorder.write(radome.Gap(8, 0, "disconnected"))
            recorder.write(desk_frames[9])
        assert recorder.report["gaps"] == 2 and recorder.report["frames_lost"] == 2
        with radome.open(path) as source:
            assert [frame.sequence for frame in source] == [2, 3, 6, 7, 9]
            assert source.gaps == [radome.Gap(4, 2, "recorded"), radome.Gap(8, 0, "disconnected")]

    def test_frames_out_of_order_are_not_recorded(self, tmp_path, desk_frames):
        with radome.Recorder(tmp_path / "order.mcap", desk_frames[0].waveform) as recorder:
            recorder.write(desk_frames[5])
            for sequence in (3, 5):
                with pytest.raises(ValueError, match="in their order"):
                    recorder.write(desk_frames[sequence])
            recorder.write(desk_frames[6])
        assert recorder.report["frames"] == 2 and recorder.report["gaps"] == 0

    @pytest.mark.parametrize(
        "label",
        [
            radome.Label(3.0, 1.0, "one"),
            radome.Label(float("nan"), 1.0, "one"),
            radome.Label(0.0, float("inf"), "one"),
            radome.Label(-1.0, 1.0, "one"),
            radome.Label(0.0, 1.0, " "),
            radome.Label(0.0, 1.0, "one", confidence=1.5),
            radome.Label(0.0, 1.0, "one", confidence=float("nan")),
        ],
    )
    def test_labels_that_cannot_be_are_not_recorded(self, tmp_path, desk_frames, label):
        path = tmp_path / "label.mcap"
        with radome.Recorder(path, desk_frames[0].waveform) as recorder:
            recorder.write(desk_frames[0])
            with pytest.raises(ValueError, match="label"):
                recorder.write(label)
        with radome.open(path) as source:
            assert source.labels == []

    def test_a_recording_has_its_own_waveform(self, recording):
        with pytest.raises(radome.RadomeError, match="recording has"):
            radome.open(recording, waveform="paper")

    def test_an_impossible_waveform_names_the_quantity(self, desk_frames):
        with pytest.raises(radome.RadomeError, match="sample_rate_hz"):
            desk_frames[0].waveform.replace(sample_rate_hz=1.0)
        with pytest.raises(radome.RadomeError, match="colour"):
            desk_frames[0].waveform.replace(colour=1)
        with pytest.raises(radome.RadomeError, match="^waveform: rx_antennas"):
            desk_frames[0].waveform.replace(rx_antennas=[9])

    def test_numbers_of_numpy_are_numbers(self, desk_frames):
        with radome.simulate(DESK, frames=np.int64(2), seed=np.int64(3), people=np.uint8(1)) as source:
            assert all(np.array_equal(a.codes, b.codes) for a, b in zip(source, desk_frames))
        changed = {"samples_per_chirp": np.int32(32), "if_gain_db": np.float32(33.0), "rx_antennas": np.array([1, 3])}
        waveform = desk_frames[0].waveform.replace(**changed)
        assert waveform.shape == (2, 8, 32) and waveform.request["if_gain_db"] == 33.0
        spec = {"channels": {"one": np.int64(1)}, "chirp_mean_removal": np.bool_(True)}
        assert radome.rdm(desk_frames[0], spec).shape[0] == 1

    def test_counts_and_people_that_cannot_be_are_named(self):
        for name, value in [("frames", -1), ("seed", -1), ("seed", 2**64), ("people", -1)]:
            with pytest.raises(radome.ArgumentError, match=f"^{name} is {value}, expected"):
                radome.simulate(DESK, **{name: value})
        corridor = FIXTURES / "scenes" / "corridor.toml"
        with pytest.raises(radome.ArgumentError, match="person 5 is not there") as error:
            radome.paths(corridor, person=5)
        assert isinstance(error.value, radome.RadomeError) and isinstance(error.value, ValueError)
        assert error.value.hint is not None
        # The number was ignored.
        with pytest.raises(radome.RadomeError, match="70 people asked for"):
            radome.paths(corridor, people=70)

    @pytest.mark.parametrize("value", [float("nan"), float("-inf"), np.float32("inf")])
    def test_numbers_that_are_not_finite_are_named(self, desk_frames, value):
        for name in ("time_s", "margin_db"):
            with pytest.raises(radome.ArgumentError, match=f"{name} is"):
                radome.paths(FIXTURES / "scenes" / "corridor.toml", **{name: value})
        with pytest.raises(ValueError, match="tolerance_db is"):
            radome.simulate(DESK, tolerance_db=value)
        with pytest.raises(ValueError, match="sample_rate_hz is"):
            desk_frames[0].waveform.replace(sample_rate_hz=value)
        with pytest.raises(ValueError, match="alpha is"):
            radome.rdm(desk_frames[0], {"static_removal": {"recursive_mti": {"alpha": value}}})
