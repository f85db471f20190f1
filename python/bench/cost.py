"""What Python adds to the work of the crates: time of the import, cost of a frame, memory over many frames.

``target/python-venv/bin/python python/bench/cost.py [FRAMES]`` prints one JSON object. FRAMES (a million) small frames are read for
the memory. Reading, maps and labels are timed beside the example ``frame_cost`` of the crates, simulation beside the program: in
turns, Python and Rust one after the other, and a ratio is the median of those of the turns, or "absent" where the example or the
program is not built. ``cargo build --release --workspace --bins --example frame_cost`` builds both; ``RADOME_FRAME_COST`` and
``RADOME_PROGRAM`` name others. All run on one thread, but for the one that reads for Python.
"""

import collections
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import radome

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "fixtures" / "scenes"
PROGRAM = Path(os.environ.get("RADOME_PROGRAM", ROOT / "target" / "release" / "radome"))
EXAMPLE = Path(os.environ.get("RADOME_FRAME_COST", ROOT / "target" / "release" / "examples" / "frame_cost"))
MODEL = ROOT / "fixtures" / "models" / "room-hqnn.safetensors"
# Frames of one simulation are a thread's work each: with several, threads of both sides would take turns on the cores.
os.environ["RAYON_NUM_THREADS"] = "1"


def timed_s(work, turns=5):
    """Median time of some turns, s."""
    times = []
    for _ in range(turns):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def import_s(code, turns=9):
    """Time of a new interpreter for some imports, less that of one without them, s: the median of turns."""

    def run(code):
        return timed_s(lambda: subprocess.run([sys.executable, "-c", code], check=True), 1)

    return statistics.median(run(code) - run("pass") for _ in range(turns))


def simulated_by_program(frames):
    arguments = [PROGRAM, "scene", "simulate", SCENES / "corridor.toml", "--frames", str(frames), "--json"]
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)["seconds"]


def least_us(work, frames, rounds=9):
    """Least processor time of some rounds over so many frames, us a frame.

    It is that of all threads, as in the example: the time of the thread that reads does not hide behind that of the one that takes.
    """
    times = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return 1e6 * min(times) / frames


def costs_in_rust(path):
    return json.loads(subprocess.run([EXAMPLE, path, MODEL], check=True, capture_output=True, text=True).stdout)


def frame_costs(path, turns=3):
    """Costs of a frame of a recording, us, and their ratios to those in Rust: reading, map of the default spec, label."""
    with radome.open(path) as source:
        frames = list(source)
    model = radome.Model(MODEL)
    works = {
        "read": lambda: read(path),
        "map": lambda: collections.deque(map(radome.rdm, frames), 0),
        "label": lambda: collections.deque(map(model, frames), 0),
    }
    ours, ratios = {name: [] for name in works}, {name: [] for name in works}
    for _ in range(turns):
        rust = costs_in_rust(path) if EXAMPLE.exists() else None
        for name, work in works.items():
            ours[name].append(least_us(work, len(frames)))
            if rust:
                ratios[name].append(ours[name][-1] / rust[f"{name}_us"])
    said = {f"{name}_us": statistics.median(times) for name, times in ours.items()}
    for name, of_turns in ratios.items():
        said[f"{name}_ratio_to_rust"] = statistics.median(of_turns) if of_turns else "absent"
    return said


def simulation_ratio(frames, turns=5):
    """Time of a simulation over that in the program."""
    ratios = []
    for _ in range(turns):
        # The program's clock starts behind the scene's preparation, and so does this one.
        with radome.simulate(SCENES / "corridor.toml", frames=frames, seed=1) as source:
            python_s = timed_s(lambda: sum(1 for _ in source), 1)
        ratios.append(python_s / simulated_by_program(frames))
    return statistics.median(ratios)


def recording(path, scene, frames):
    """A recording of so many frames of a scene."""
    with radome.simulate(SCENES / scene, frames=frames) as source:
        with radome.Recorder(path, source.waveform) as recorder:
            for frame in source:
                recorder.write(frame)
    return path


def read(path):
    """Reads a recording, and a code of each frame."""
    with radome.open(path) as source:
        assert sum(int(frame.codes[0, 0, 0]) for frame in source) > 0


def memory_kb(frames, path):
    """Growth of the peak memory from the first tenth of so many frames to the last, kB."""
    peaks = []
    for _ in range(max(10, frames // 1000)):
        read(path)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peaks[-1] - peaks[len(peaks) // 10]


def main():
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    said = {"import_s": import_s("import radome"), "import_with_numpy_s": import_s("import numpy, radome")}
    said["import_of_numpy_alone_s"] = import_s("import numpy")
    with radome.simulate(SCENES / "desk.toml", frames=1) as source:
        frame = next(source)
    said["codes_view_us"] = 1e6 * timed_s(lambda: frame.codes, 200)
    said["simulation_ratio_to_program"] = simulation_ratio(300) if PROGRAM.exists() else "absent"
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        # 3 receivers, 8 chirps and 64 samples; the waveform of the room models, 1 x 64 x 128; 3 x 128 x 256.
        small = recording(folder / "small.mcap", "desk.toml", 1000)
        said["small_frame"] = frame_costs(small)
        said["room_frame"] = frame_costs(recording(folder / "room.mcap", "rooms-still.toml", 200))
        said["paper_frame"] = frame_costs(recording(folder / "paper.mcap", "corridor.toml", 100))
        said["memory_growth_kb"] = memory_kb(frames, small)
    print(json.dumps(said))


if __name__ == "__main__":
    main()
