"""Schemas of TOML files, and the fixtures that name them in their first lines."""

import json

import jsonschema
import pytest

from conftest import FIXTURES

tomllib = pytest.importorskip("tomllib", reason="Python 3.11 and later read TOML")

DIRECTIVE = "#:schema "
NAMED = [path for path in sorted(FIXTURES.rglob("*.toml")) if path.read_text("utf-8").startswith(DIRECTIVE)]


def schema_of(path):
    """Checker by the schema that a file names."""
    first = path.read_text("utf-8").splitlines()[0]
    schema = json.loads((path.parent / first.removeprefix(DIRECTIVE)).read_text("utf-8"))
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


def with_value(path, keys, value):
    """Content of a file with another value at a place."""
    content = tomllib.loads(path.read_text("utf-8"))
    at = content
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    return content


@pytest.mark.parametrize("path", NAMED, ids=lambda path: str(path.relative_to(FIXTURES)))
def test_a_fixture_is_what_its_schema_says(path):
    schema_of(path).validate(tomllib.loads(path.read_text("utf-8")))


@pytest.mark.parametrize(
    "name, table",
    [
        ("scenes/bedroom.toml", []),
        ("scenes/bedroom.toml", ["room"]),
        ("scenes/bedroom.toml", ["room", "floor"]),
        ("scenes/bedroom.toml", ["furniture", 0]),
        ("ladder/scenes/rest.toml", ["receiver"]),
        ("receivers/desk.toml", []),
        ("receivers/desk.toml", ["rx", 0]),
        ("datasets/rooms.toml", []),
        ("datasets/rooms.toml", ["map"]),
        ("datasets/rooms.toml", ["simulated", 0]),
        ("datasets/room-cnn-training.toml", []),
        ("datasets/room-cnn-training.toml", ["smoothing"]),
        ("studies/circuits.toml", []),
        ("studies/circuits.toml", ["train"]),
        ("studies/strangers.toml", ["conditions", 0]),
    ],
)
def test_a_wrong_key_is_refused(name, table):
    path = FIXTURES / name
    assert not schema_of(path).is_valid(with_value(path, [*table, "no_such_key"], 1))


@pytest.mark.parametrize(
    "name, keys, value",
    [
        ("scenes/bedroom.toml", ["format"], "1"),
        ("scenes/bedroom.toml", ["room", "size_m"], [3.8, 4.2]),
        ("scenes/bedroom.toml", ["room", "solver"], "guess"),
        ("scenes/bedroom.toml", ["waveform", "chirps_per_frame"], -1),
        ("datasets/rooms.toml", ["simulated", 0, "seeds"], [1]),
        ("datasets/rooms.toml", ["simulated", 0, "waveform"], {"chirps": 32}),
        ("datasets/room-cnn-training.toml", ["split", "by"], "colour"),
        ("studies/circuits.toml", ["seeds"], 11),
    ],
)
def test_a_wrong_value_is_refused(name, keys, value):
    path = FIXTURES / name
    assert not schema_of(path).is_valid(with_value(path, keys, value))


def test_some_keys_of_a_map_or_a_waveform_are_enough():
    path = FIXTURES / "datasets" / "rooms.toml"
    assert schema_of(path).is_valid(with_value(path, ["map"], {"floor_db": -150.0}))
    assert schema_of(path).is_valid(with_value(path, ["simulated", 0, "waveform"], {"chirps_per_frame": 32}))
