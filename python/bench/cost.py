"""What Python adds to the work of the crates: time of the import, cost of a frame, memory over many frames.

``target/python-venv/bin/python python/bench/cost.py [FRAMES]`` prints one JSON object. FRAMES (a million) small frames are read for
the memory. Simulation is timed beside the program (``target/release/radome``), where it is built. The time of a map is to be
compared with that of ``radome bench rdm``.
"""

import json
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
PROGRAM = ROOT / "target" / "release" / "radome"


def timed_s(work, turns=5):
    """Median time of some turns, s."""
    times = []
    for _ in range(turns):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def import_s():
    """Time that the package's import adds to that of NumPy, s."""

    def run(code):
        return lambda: subprocess.run([sys.executable, "-c", code], check=True)

    return timed_s(run("import numpy, radome")) - timed_s(run("import numpy"))


def simulated(frames):
    with radome.simulate(SCENES / "corridor.toml", frames=frames, seed=1) as source:
        return sum(1 for _ in source)


def simulated_by_program(frames):
    arguments = [PROGRAM, "scene", "simulate", SCENES / "corridor.toml", "--frames", str(frames), "--json"]
    return json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)["seconds"]


def memory_kb(frames, folder):
    """Growth of the peak memory from the first tenth of so many frames to the last, kB."""
    with radome.simulate(SCENES / "desk.toml", frames=1000) as source:
        with radome.Recorder(folder / "small.mcap", source.waveform) as recorder:
            for frame in source:
                recorder.write(frame)
    peaks = []
    for turn in range(max(10, frames // 1000)):
        with radome.open(folder / "small.mcap") as source:
            total = sum(int(frame.codes[0, 0, 0]) for frame in source)
        assert total > 0
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peaks[-1] - peaks[len(peaks) // 10]


def main():
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    codes = np.random.default_rng(1).integers(0, 4096, radome.Waveform.load("paper").shape, dtype=np.uint16)
    frame = radome.Frame.from_array(codes, radome.Waveform.load("paper"))
    model, said = radome.Model(), {"import_s": import_s()}
    with radome.simulate(SCENES / "rooms-still.toml", frames=1) as source:
        room = next(source)
    said["map_of_paper_frame_us"] = 1e6 * timed_s(lambda: radome.rdm(frame), 200)
    said["codes_view_us"] = 1e6 * timed_s(lambda: frame.codes, 200)
    said["label_of_room_frame_us"] = 1e6 * timed_s(lambda: model(room), 200)
    python_s = timed_s(lambda: simulated(200), 3)
    said["simulated_frames_per_s"] = 200 / python_s
    if PROGRAM.exists():
        said["simulation_ratio_to_program"] = python_s / statistics.median(simulated_by_program(200) for _ in range(3))
    with tempfile.TemporaryDirectory() as folder:
        said["memory_growth_kb"] = memory_kb(frames, Path(folder))
    print(json.dumps(said))


if __name__ == "__main__":
    main()
