"""Models, datasets, training and the quantum layer."""

import fcntl
import multiprocessing
import pickle
import threading

import numpy as np
import pytest

import radome
from conftest import DESK, FIXTURES, ROOM, SPEC

#: A training of seconds.
QUICK = {"epochs": 3, "starts": 1, "reference": {"over_noise": {"skip_range_bins": 3}}}


@pytest.fixture(scope="module")
def room_frames():
    with radome.simulate(ROOM, frames=6, seed=1) as source:
        return list(source)


def train(path, **keywords):
    return radome.train(path, QUICK, network="descriptor_linear", **keywords)


def test_a_model_judges_frames_and_maps_alike(room_frames):
    model = radome.Model()
    of_frame = model(room_frames[0])
    assert of_frame.shape == (3,) and of_frame.dtype == np.float32 and of_frame.sum() == pytest.approx(1.0, abs=1e-5)
    assert np.array_equal(model(radome.rdm(room_frames[0], model.rdm_spec)), of_frame)


def test_a_model_refuses_maps_of_another_spec(room_frames):
    model = radome.Model()
    with pytest.raises(radome.RadomeError, match="floor_db -55.0 instead of"):
        model(radome.rdm(room_frames[0], {**model.rdm_spec, "floor_db": -55.0}))


def test_a_model_is_saved_and_read(tmp_path, room_frames):
    model, path = radome.Model(), tmp_path / "model.safetensors"
    model.save(path)
    assert np.array_equal(radome.Model(path)(room_frames[0]), model(room_frames[0]))
    with pytest.raises(FileExistsError):
        model.save(path)
    model.save(path, overwrite=True)


def test_a_counter_answers_to_every_frame(room_frames):
    answers = list(radome.Counter().answers(room_frames))
    assert [answer.sequence for answer in answers] == [frame.sequence for frame in room_frames]
    assert all(answer.label in radome.CLASSES for answer in answers)
    assert all(answer.probabilities.sum() == pytest.approx(1.0, abs=1e-5) for answer in answers)
    # The filter does not follow a single frame at once.
    first, second = answers[0].probabilities, answers[0].frame_probabilities
    assert not np.array_equal(first, second)


def test_a_model_becomes_onnx(tmp_path):
    radome.export(FIXTURES / "models" / "paper-hqnn.safetensors", tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").stat().st_size > 1000
    with pytest.raises(FileExistsError):
        radome.export(FIXTURES / "models" / "paper-hqnn.safetensors", tmp_path / "model.onnx")
    with pytest.raises(radome.RadomeError):
        radome.export("room-hqnn", tmp_path / "other.onnx")
    assert not (tmp_path / "other.onnx").exists()


def test_a_dataset_is_a_sequence_of_maps_and_classes(dataset_path):
    dataset = radome.Dataset(dataset_path)
    assert len(dataset) == 48 and dataset.labels.tolist() == [0] * 16 + [1] * 16 + [2] * 16
    cells, label = dataset[0]
    with radome.simulate(DESK, frames=1, seed=0, people=0) as source:
        assert np.array_equal(cells, radome.rdm(next(source), SPEC).db) and label == 0
    assert np.shares_memory(dataset.map(0), dataset.map(0)) and not cells.flags.writeable
    with pytest.raises(IndexError):
        dataset[48]
    assert dataset[-1][1] == 2
    dataset.verify()
    parts = [radome.Dataset(dataset_path, split=split) for split in ("train", "validation", "test")]
    assert sorted(np.concatenate([part.indices for part in parts]).tolist()) == list(range(48))
    sequences = [{row["sequence"] for row in part.rows} for part in parts]
    assert not (sequences[0] & sequences[1] or sequences[0] & sequences[2] or sequences[1] & sequences[2])
    copies = radome.Dataset(dataset_path, transform=np.array)
    assert copies[0][0].flags.writeable


def test_a_dataset_is_found_from_another_folder(tmp_path, dataset_path, monkeypatch):
    monkeypatch.chdir(dataset_path.parent)
    dataset = radome.Dataset(dataset_path.name)
    monkeypatch.chdir(tmp_path)
    assert dataset[0][0].shape == radome.Dataset(dataset_path)[0][0].shape
    assert len(pickle.loads(pickle.dumps(dataset))) == 48
    dataset.verify()


def test_what_holds_no_state_of_the_compiled_part_is_pickled(desk_frames):
    kept = [desk_frames[0].waveform, radome.Gap(1, 2, "crc"), radome.Label(0.0, 1.0, "one")]
    assert pickle.loads(pickle.dumps(kept)) == kept
    model = radome.Model()
    for lent in (desk_frames[0], radome.rdm(desk_frames[0]), model, model.filter(0.1), radome.Counter(model), radome.Circuit()):
        with pytest.raises(TypeError):
            pickle.dumps(lent)


def label_sum(dataset):
    return sum(label for _, label in (dataset[index] for index in range(len(dataset))))


@pytest.mark.parametrize("method", [m for m in ("fork", "spawn") if m in multiprocessing.get_all_start_methods()])
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_workers_read_a_dataset_as_a_loader_has_them_do(dataset_path, method):
    dataset = radome.Dataset(dataset_path)
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(label_sum, [dataset, dataset]) == [48, 48]
    assert len(pickle.loads(pickle.dumps(dataset))) == 48


def test_a_training_is_a_function_of_its_settings(tmp_path, dataset_path):
    epochs = []
    first = train(dataset_path, report=epochs.append)
    assert [epoch["epoch"] for epoch in epochs] == [1, 2, 3] and len(first.history) == 3

    class Enough(Exception):
        pass

    def stop(epoch):
        if epoch["epoch"] == 2:
            raise Enough

    checkpoint = tmp_path / "half.checkpoint"
    with pytest.raises(Enough):
        train(dataset_path, checkpoint=checkpoint, report=stop)
    # Another training with this checkpoint, which also went on from it and removed it.
    with open(tmp_path / "half.checkpoint.lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(radome.RadomeError, match="another process is at work"):
            train(dataset_path, checkpoint=checkpoint)
    again = train(dataset_path, checkpoint=checkpoint)
    first.model.save(tmp_path / "first.safetensors")
    again.model.save(tmp_path / "again.safetensors")
    assert (tmp_path / "first.safetensors").read_bytes() == (tmp_path / "again.safetensors").read_bytes()
    scores = radome.evaluate(first.model, radome.Dataset(dataset_path, split="test"))
    assert scores == first.test and scores["samples"] == 12


def test_a_model_is_adapted_to_recordings(tmp_path):
    recordings = []
    for label, people in (("empty", 0), ("one", 1)):
        for seed in (11, 12):
            path = tmp_path / f"{label}-{seed}.mcap"
            with radome.simulate(ROOM, frames=12, seed=seed, people=people) as source:
                with radome.Recorder(path, source.waveform) as recorder:
                    for frame in source:
                        recorder.write(frame)
            recordings.append((path, label))
    result = radome.adapt("room-hqnn", recordings)
    assert result.adapted["recordings"] == 4 and result.recordings_by_class == [2, 2, 0]
    assert len(result.held_out) == 4 and result.model.card["adapted"] == result.adapted
    assert result.adapted["seconds"][0] == pytest.approx(2.4, abs=0.11)


def test_the_circuit_is_qiskits(circuit_points):
    names = radome.Circuit().observables
    for point in circuit_points:
        result = radome.circuit(point["x"], point["theta"])
        for found, key in ((result.expectations, "exp"), (result.by_theta, "grad_theta"), (result.by_x, "grad_x")):
            assert np.allclose(found, [point[key][name] for name in names], atol=1e-9)


def test_gradients_of_the_circuit_are_those_of_differences():
    rng = np.random.default_rng(1)
    for circuit in (radome.Circuit(), radome.Circuit(qubits=3, depth=2)):
        x, theta = rng.uniform(0.0, 3.0, (4, circuit.qubits)), rng.uniform(-1.0, 1.0, circuit.angle_count)
        result = circuit.jacobian(x, theta)
        assert np.allclose(result.expectations, circuit(x, theta), atol=1e-14)
        assert result.by_x.shape == (4, circuit.qubits, circuit.qubits)
        step = 1e-6
        for k in range(circuit.angle_count):
            moved = np.zeros_like(theta)
            moved[k] = step
            slope = (circuit(x, theta + moved) - circuit(x, theta - moved)) / (2.0 * step)
            assert np.allclose(result.by_theta[:, :, k], slope, atol=1e-8)
        for k in range(circuit.qubits):
            moved = np.zeros_like(x)
            moved[:, k] = step
            slope = (circuit(x + moved, theta) - circuit(x - moved, theta)) / (2.0 * step)
            assert np.allclose(result.by_x[:, :, k], slope, atol=1e-8)


class TestHardCases:
    def test_a_model_for_another_waveform_says_what_differs(self, desk_frames):
        model = radome.Model(FIXTURES / "models" / "paper-hqnn.safetensors")
        for judge in (model, radome.Counter(model)):
            with pytest.raises(radome.RadomeError, match="waveforms differ") as error:
                judge(desk_frames[0])
            assert "waveform" in error.value.hint
        with pytest.raises(radome.RadomeError, match="waveforms differ"):
            model.check_waveform(desk_frames[0].waveform)

    def test_a_frame_without_a_signal_has_no_answer(self, room_frames):
        waveform = room_frames[0].waveform
        dead = radome.Frame.from_array(np.zeros(waveform.shape, dtype=np.uint16), waveform)
        assert radome.Model()(dead) is None
        assert radome.Counter()(dead).label is None

    def test_what_is_no_frame_is_refused(self, room_frames):
        with pytest.raises(TypeError):
            radome.Model()(room_frames[0].codes)

    def test_two_threads_share_a_model(self, room_frames):
        model = radome.Model(FIXTURES / "models" / "room-cnn.safetensors")
        maps = [radome.rdm(frame, model.rdm_spec) for frame in room_frames]
        alone, found = [model(map).tolist() for map in maps], {}

        def judge(name):
            found[name] = [model(map).tolist() for _ in range(20) for map in maps]

        threads = [threading.Thread(target=judge, args=(name,)) for name in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
        assert found == {0: alone * 20, 1: alone * 20}

    def test_circuits_check_their_inputs(self):
        with pytest.raises(radome.RadomeError, match="expected 4"):
            radome.circuit([0.1, 0.2], [0.1])
        with pytest.raises(radome.ArrayTypeError):
            radome.circuit([0.1, 0.2], ["a", "b", "c", "d"])
        with pytest.raises(ValueError, match="not finite"):
            radome.circuit([0.1, float("nan")], [0.1] * 4)
        with pytest.raises(radome.ArrayValueError):
            radome.circuit(0.1, [0.1] * 4)
        with pytest.raises(radome.RadomeError, match="qubits"):
            radome.Circuit(qubits=100)
        x, theta = np.array([[0.5, 1.0]]), np.array([0.1, 0.2, 0.3, 0.4])
        expected = radome.circuit(x, theta).expectations
        assert np.array_equal(radome.circuit(x.astype(">f8"), np.repeat(theta, 2)[::2]).expectations, expected)

    def test_a_dataset_is_not_replaced(self, dataset_path, desk_frames):
        with pytest.raises(radome.ExistingFileError, match="exists"):
            radome.DatasetWriter(dataset_path, desk_frames[0].waveform, SPEC)
        with pytest.raises(ValueError):
            radome.Dataset(dataset_path, split="rest")
        with pytest.raises(FileNotFoundError):
            radome.Dataset(dataset_path / "none")
        for split in (None, "train"):
            with pytest.raises(radome.RadomeError, match="split: unknown field `x`"):
                radome.Dataset(dataset_path, split=split, rule={"x": 1})

    def test_a_training_divides_by_the_rule_of_its_dataset(self, tmp_path, dataset_path):
        rule = {"seed": 5, "test": 0.5, "validation": 0.25}
        ruled = radome.Dataset(dataset_path, split="train", rule=rule)
        trained = train(ruled)
        held = radome.Dataset(dataset_path, split="test", rule=rule)
        assert trained.test == radome.evaluate(trained.model, held)
        by_settings = radome.train(dataset_path, {**QUICK, "split": rule}, network="descriptor_linear")
        assert by_settings.test == trained.test and by_settings.validation == trained.validation
        # Divided by the default rule, the test split held maps that the model was trained on.
        test = radome.Dataset(dataset_path, split="test")
        assert radome.evaluate(by_settings.model, test) == by_settings.test
        assert radome.evaluate(by_settings.model, dataset_path)["samples"] == 48
        with pytest.raises(ValueError, match="give one of them"):
            radome.train(ruled, {**QUICK, "split": {"seed": 6}})
        file = tmp_path / "training.toml"
        file.write_text("epochs = 1\n")
        with pytest.raises(ValueError, match="under \\[split\\]"):
            radome.train(ruled, file)
        with pytest.raises(ValueError, match="without rule"):
            radome.adapt("room-hqnn", [], simulated=ruled)

    def test_a_split_to_judge_by_is_not_learnt_from(self, dataset_path):
        for split in ("validation", "test"):
            dataset = radome.Dataset(dataset_path, split=split)
            with pytest.raises(ValueError, match="without split"):
                train(dataset)
            with pytest.raises(ValueError, match="without split"):
                radome.adapt("room-hqnn", [], simulated=dataset)

    def test_settings_that_cannot_be_are_refused(self, dataset_path):
        with pytest.raises(radome.RadomeError, match="epochs"):
            radome.train(dataset_path, {"epochs": 0})
        with pytest.raises(radome.RadomeError, match="colour"):
            radome.train(dataset_path, {"colour": 1})
        with pytest.raises(FileNotFoundError, match="none.toml"):
            radome.train(dataset_path, "none.toml")
        with pytest.raises(radome.RadomeError) as error:
            radome.train(dataset_path, network="house")
        assert "networks" in error.value.hint
