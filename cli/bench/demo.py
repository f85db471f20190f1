#!/usr/bin/env python3
"""Balanced accuracy of `radome demo` over unseen seeds: median and lowest, with and without the frames of entering and leaving.

    python3 cli/bench/demo.py [FIRST LAST [MODEL]]        # default 100001 100020, the shipped model; JSON on stdout
"""
import json, pathlib, statistics, subprocess, sys

root = pathlib.Path(__file__).resolve().parents[2]
first, last = (int(a) for a in (sys.argv[1:3] or ("100001", "100020")))
model = ["--model", sys.argv[3]] if len(sys.argv) > 3 else []
runs = []
for seed in range(first, last + 1):
    command = [root / "target/release/radome", "demo", "--speed", "0", "--json", "--seed", str(seed)]
    lines = subprocess.check_output([*command, *model], text=True, stderr=subprocess.DEVNULL).splitlines()
    summary = json.loads(lines[-1])["summary"]
    runs.append({
        "seed": seed,
        "balanced_accuracy": summary["balanced_accuracy"],
        "without_transitions": summary["metrics_without_transitions"]["balanced_accuracy"],
        "unfiltered": summary["metrics_unfiltered"]["balanced_accuracy"],
        "transition_frames": summary["transition_frames"],
        "dropped": summary["dropped"],
        "first_label_s": summary["first_label_s"],
        "latency_ms": summary["latency_ms"],
    })
over = lambda f, key: f(run[key] for run in runs)
print(json.dumps({
    "median": over(statistics.median, "balanced_accuracy"), "lowest": over(min, "balanced_accuracy"),
    "median_without_transitions": over(statistics.median, "without_transitions"),
    "median_unfiltered": over(statistics.median, "unfiltered"),
    "transition_frames": over(sum, "transition_frames"), "dropped": over(sum, "dropped"),
    "latest_first_label_s": over(max, "first_label_s"), "runs": runs,
}, indent=1))
