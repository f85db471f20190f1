#!/usr/bin/env python3
"""The job of `radome bench rdm` in scipy f32 on one thread: codes of a shape (3x128x256) to dB maps.

    python3 -m venv .venv && .venv/bin/pip install numpy scipy && radome bench rdm --python .venv/bin/python

`radome bench rdm` and `bench scene` call it with the shape, and measure beside it.
"""
import json, os, sys, time
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
import numpy as np
import scipy.fft

R, M, N = map(int, (sys.argv[1] if len(sys.argv) > 1 else "3x128x256").split("x"))
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


print(json.dumps({"scipy_f32_microseconds": fastest()}))
