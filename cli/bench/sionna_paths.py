#!/usr/bin/env python3
"""Times one search of sionna-rt for the specular paths of a room: so `radome bench scene --python PYTHON` calls it.

Reads JSON on standard input: "triangles" (three places each, m), "antenna_m", "reflections", "rays". All surfaces are concrete: what
they are made of does not change the time. Prints the least of five searches after one that compiles. Needs sionna-rt.
"""
import contextlib
import json
import pathlib
import sys
import tempfile
import time

with contextlib.redirect_stdout(sys.stderr):
    from sionna.rt import ITURadioMaterial, PathSolver, PlanarArray, Receiver, SceneObject, Transmitter, load_scene

FREQUENCY_HZ = 60e9
ROUNDS = 5


def write_obj(path, triangles):
    places = [f"v {x:.9f} {y:.9f} {z:.9f}" for triangle in triangles for x, y, z in triangle]
    faces = [f"f {3 * t + 1} {3 * t + 2} {3 * t + 3}" for t in range(len(triangles))]
    path.write_text("\n".join(places + faces) + "\n")


def search(request):
    """A function that searches once and waits for what it finds."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "room.obj"
        write_obj(path, request["triangles"])
        scene = load_scene()
        scene.frequency = FREQUENCY_HZ
        concrete = ITURadioMaterial(name="walls", itu_type="concrete", thickness=0.2)
        scene.edit(add=[SceneObject(fname=str(path), name="room", radio_material=concrete)])
    one = PlanarArray(num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V")
    scene.tx_array = scene.rx_array = one
    x, y, z = request["antenna_m"]
    scene.add(Transmitter("tx", position=[x, y - 0.003, z]))
    scene.add(Receiver("rx", position=[x, y + 0.002, z]))
    solver = PathSolver()

    def once():
        paths = solver(scene, max_depth=request["reflections"], samples_per_src=request["rays"], los=False,
                       specular_reflection=True, diffuse_reflection=False, refraction=False)
        return paths.cir(normalize_delays=False, out_type="numpy")

    return once


def milliseconds(once):
    start = time.perf_counter()
    once()
    return (time.perf_counter() - start) * 1e3


with contextlib.redirect_stdout(sys.stderr):
    once = search(json.load(sys.stdin))
    once()
    least = min(milliseconds(once) for _ in range(ROUNDS))
print(json.dumps({"sionna_milliseconds": least}))
