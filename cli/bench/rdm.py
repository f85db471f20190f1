#!/usr/bin/env python3
"""The job of `radome bench rdm` in scipy f32 on one thread: 3 x 128 x 256 codes to dB maps. Needs numpy and scipy.

    python3 -m venv .venv && .venv/bin/pip install numpy scipy && .venv/bin/python cli/bench/rdm.py

Runs radome in between, so that both are measured on the machine as it is now, and prints the ratio as JSON. With --peer, and
perhaps another shape (1x64x128), it prints scipy's time alone: so `radome bench rdm` and `bench scene --python .venv/bin/python` call it.
"""
import json, os, pathlib, subprocess, sys, time
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
import numpy as np
import scipy.fft

shape = sys.argv[sys.argv.index("--peer") + 1:] if "--peer" in sys.argv else []
R, M, N = map(int, shape[0].split("x")) if shape else (3, 128, 256)
rng = np.random.default_rng(1)
codes = rng.integers(0, 4096, (R, M, N)).astype(np.uint16)
periodic = lambda n: (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)).astype(np.float32)
range_window, doppler_window = periodic(N), periodic(M)
scale = np.float32(2 / (range_window.sum() * doppler_window.sum()))
window = (range_window[None, :] * doppler_window[:, None] * scale)[None]


def maps(codes):
    x = (codes.astype(np.float32) - np.float32(2048)) * np.float32(1 / 2048)
    x *= window
    spectrum = scipy.fft.rfft(x, axis=2, workers=1)[:, :, :N // 2]
    spectrum = scipy.fft.fftshift(scipy.fft.fft(spectrum, axis=1, workers=1, overwrite_x=True), axes=1)
    power = spectrum.real ** 2 + spectrum.imag ** 2
    power[:, :, 0] *= np.float32(0.25)
    np.maximum(power, np.float32(1e-20), out=power)
    return np.float32(10) * np.log10(power)


def fastest(rounds=200):
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        maps(codes)
        best = min(best, time.perf_counter() - start)
    return best * 1e6


if "--peer" in sys.argv:
    print(json.dumps({"scipy_f32_microseconds": fastest()}))
    sys.exit()
root = pathlib.Path(__file__).resolve().parents[2]
before = fastest()
ours = json.loads(subprocess.check_output([root / "target/release/radome", "bench", "rdm", "--json"]))
scipy_us = min(before, fastest())
print(json.dumps({"scipy_f32_microseconds": scipy_us, "radome": ours,
                  "times_faster": scipy_us / (1e3 * ours[0]["milliseconds"])}))
