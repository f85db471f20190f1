"""What Python adds to the work of the crates: time of the import, cost of a frame, memory over many frames.

``target/python-venv/bin/python python/bench/cost.py [FRAMES]`` prints one JSON object. FRAMES (a million) small frames are read for
the memory. Where the program (``target/release/radome``) is built, simulation and maps are timed beside it: in turns, Python and
the program one after the other, and a ratio is the median of those of the turns. Both simulate on one thread.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import radome

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "fixtures" / "scenes"
PROGRAM = Path(os.environ.get("RADOME_PROGRAM", ROOT / "target" / "release" / "radome"))
# Frames of one simulation are a thread's work each: with several, threads of both sides would take turns on the cores.
os.environ["RAYON_NUM_THREADS"] = "1"


def timed_s(work, turns=5, clock=time.perf_counter):
    """Median time of some turns, s."""
    times = []
    for _ in range(turns):
        began = clock()
        work()
        times.append(clock() - began)
    return statistics.median(times)


def import_s(code, turns=9):
    """Time of a new interpreter for some imports, less that of one without them, s: the median of turns."""

    def run(code):
        return timed_s(lambda: subprocess.run([sys.executable, "-c", code], check=True), 1)

    return statistics.median(run(code) - run("pass") for _ in range(turns))


def simulated_by_program(frames):
    arguments = [PROGRAM, "scene", "simulate", SCENES / "corridor.toml", "--frames", str(frames), "--json"]
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)["seconds"]


def map_ratio(frame, turns=3):
    """Time of a map of three receivers, 128 chirps and 256 samples over that in the program."""
    ratios = []
    for _ in range(turns):
        python_s = timed_s(lambda: radome.rdm(frame), 500)
        done = subprocess.run([PROGRAM, "bench", "rdm", "--json"], check=True, capture_output=True, text=True)
        ours = [row["milliseconds"] for row in json.loads(done.stdout) if not row["is_peer"]]
        ratios.append(1e3 * python_s / min(ours))
    return statistics.median(ratios)


def simulation_ratio(frames, turns=5):
    """Time of a simulation over that in the program."""
    ratios = []
    for _ in range(turns):
        # The program's clock starts behind the scene's preparation, and so does this one.
        with radome.simulate(SCENES / "corridor.toml", frames=frames, seed=1) as source:
            python_s = timed_s(lambda: sum(1 for _ in source), 1)
        ratios.append(python_s / simulated_by_program(frames))
    return statistics.median(ratios)


def small_recording(folder):
    """A recording of 1000 frames of 3 receivers, 8 chirps and 64 samples."""
    path = folder / "small.mcap"
    with radome.simulate(SCENES / "desk.toml", frames=1000) as source:
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
    codes = np.random.default_rng(1).integers(0, 4096, radome.Waveform.load("paper").shape, dtype=np.uint16)
    frame = radome.Frame.from_array(codes, radome.Waveform.load("paper"))
    model = radome.Model()
    said = {"import_s": import_s("import radome"), "import_with_numpy_s": import_s("import numpy, radome")}
    said["import_of_numpy_alone_s"] = import_s("import numpy")
    with radome.simulate(SCENES / "rooms-still.toml", frames=1) as source:
        room = next(source)
    said["map_of_paper_frame_us"] = 1e6 * timed_s(lambda: radome.rdm(frame), 200)
    said["codes_view_us"] = 1e6 * timed_s(lambda: frame.codes, 200)
    said["label_of_room_frame_us"] = 1e6 * timed_s(lambda: model(room), 200)
    if PROGRAM.exists():
        said["map_ratio_to_program"] = map_ratio(frame)
        said["simulation_ratio_to_program"] = simulation_ratio(300)
    with tempfile.TemporaryDirectory() as folder:
        path = small_recording(Path(folder))
        # Time of all threads: on a busy machine the one that reads and the one that takes wait for each other.
        said["read_of_small_frame_processor_us"] = 1e3 * timed_s(lambda: read(path), 9, time.process_time)
        said["memory_growth_kb"] = memory_kb(frames, path)
    print(json.dumps(said))


if __name__ == "__main__":
    main()
