#!/usr/bin/env python3
"""Checks files for viewers with public Python packages: `check.py RADOME`, where RADOME is the built program.

Needs the packages mcap and mcap-protobuf-support. With the package rerun-sdk, Rerun's own loader reads the file too;
without it, that part is skipped, and the last line says so. Exit status 0 if all is as it should be.
"""

import math
import pathlib
import struct
import subprocess
import sys
import tempfile

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

FORMATS = pathlib.Path(__file__).resolve().parents[2] / "fixtures" / "formats"
# Host time of the first frame of the golden recording, ns since 1970, and the interval of its frames, ns.
HOST_NS = 1_767_683_775_000_000_000
INTERVAL_NS = 400_000_000
NUMBERS = [0, 1, 2, 3, 4, 7, 8, 9]

TYPES = {
    "/radome/chirps": "foxglove.RawImage",
    "/radome/map": "foxglove.CompressedImage",
    "/radome/state": "radome.State",
    "/radome/answer": "radome.Answer",
    "/radome/events": "foxglove.Log",
}


def read(path):
    """Returns the messages of each topic as pairs of log time and message, decoded by the schemas in the file."""
    messages = {topic: [] for topic in TYPES}
    times = []
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for decoded in reader.iter_decoded_messages(log_time_order=False):
            assert decoded.schema.name == TYPES[decoded.channel.topic], decoded.schema.name
            assert decoded.schema.encoding == decoded.channel.message_encoding == "protobuf"
            messages[decoded.channel.topic].append((decoded.message.log_time, decoded.decoded_message))
            times.append(decoded.message.log_time)
    assert times == sorted(times), "times go backwards"
    return messages


def png_size(data):
    """Returns width and height of a PNG by its header."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR"
    return struct.unpack(">II", data[16:24])


def check_messages(messages):
    """Compares the messages with what the golden recording holds."""
    times = [HOST_NS + number * INTERVAL_NS for number in NUMBERS]
    for topic in ["/radome/chirps", "/radome/map", "/radome/state"]:
        assert [time for time, _ in messages[topic]] == times, topic
    for (time, image), number in zip(messages["/radome/chirps"], NUMBERS):
        assert (image.width, image.height, image.step, image.encoding) == (8, 4, 16, "16UC1")
        assert image.timestamp.ToNanoseconds() == time
        codes = struct.unpack("<32H", image.data)
        assert (codes[0], codes[10], codes[31]) == (37 * number, 37 * number + 102, 37 * number + 1107)
    for _, image in messages["/radome/map"]:
        assert image.format == "png" and png_size(image.data) == (4, 2)
    for (_, state), number in zip(messages["/radome/state"], NUMBERS):
        assert state.sequence == number and state.frames_lost == (0 if number < 5 else 2)
        assert math.isnan(state.temperature_celsius) == (number < 2)
        assert math.isnan(state.true_people) == (number % 2 == 1)
    answers = [answer for _, answer in messages["/radome/answer"]]
    assert [answer.sequence for answer in answers] == [0, 1, 2, 3, 4, 8, 9]
    assert [answer.people for answer in answers] == [0, 0, 0, 1, 1, 1, 1]
    assert answers[0].label == "" and math.isnan(answers[0].p_one)
    assert (answers[1].label, answers[1].p_one) == ("one", 0.75)
    events = [event for _, event in messages["/radome/events"]]
    assert [event.message for event in events if event.name == "people"] == ["people: 0 to 1"]
    gaps = [event for event in events if event.name == "gap"]
    levels = gaps[0].DESCRIPTOR.fields_by_name["level"].enum_type.values_by_number
    assert [(levels[gap.level].name, gap.message) for gap in gaps] == [
        ("WARNING", "2 frames lost from frame 5 on: crc")
    ]


def check_layout(path):
    """Decodes the frames of a recording by the layout that the schema of their channel states, and by nothing else."""
    sizes = {"u8": "B", "u16": "H", "u64": "Q", "i32": "i"}
    count = 0
    with open(path, "rb") as file:
        for schema, _, message in make_reader(file).iter_messages(topics=["/radome/frames"]):
            assert (schema.name, schema.encoding) == ("radome.frame", "radome.layout")
            fields, at = {}, 0
            for line in schema.data.decode().splitlines()[1:]:
                kind, name = line.split(":")[0].split(" ")
                if "[" not in kind:
                    (fields[name],) = struct.unpack_from("<" + sizes[kind], message.data, at)
                    at += struct.calcsize(sizes[kind])
                    continue
                lengths = [fields[axis] for axis in kind[kind.index("[") + 1 : -1].split("][")]
                codes = struct.unpack_from(f"<{math.prod(lengths)}H", message.data, at)
                assert at + 2 * len(codes) == len(message.data)
            assert fields["sequence"] == NUMBERS[count] and fields["time"] == NUMBERS[count] * INTERVAL_NS
            assert codes[31] == 37 * NUMBERS[count] + 1107
            count += 1
    assert count == len(NUMBERS), count


def check_rerun(path):
    """Lets Rerun's loader read the file; returns what it has found, or why it was not asked."""
    try:
        import rerun
    except ImportError:
        return "skipped: no package rerun-sdk, Rerun's loader was not asked"
    output = pathlib.Path(path).with_suffix(".rrd")
    command = [sys.executable, "-m", "rerun", "mcap", "convert", str(path), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and output.stat().st_size > 0, done.stderr
    printed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(output)], capture_output=True, text=True
    ).stdout
    for topic in TYPES:
        assert topic in printed, f"Rerun has no entity {topic}:\n{printed}"
    for component in ["EncodedImage:blob", "Image:buffer", "TextLog:text"]:
        assert component in printed, f"Rerun draws no topic as {component}:\n{printed}"
    return f"Rerun {rerun.__version__} draws maps, chirps and events"


def main():
    """Exports the golden recording and checks the result."""
    radome = sys.argv[1]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "viewers.mcap"
        convert = [radome, "recording", "convert", str(FORMATS / "judged.mcap"), str(path), "--to", "viewers"]
        subprocess.run(convert, check=True, stdout=subprocess.DEVNULL)
        check_messages(read(path))
        check_layout(FORMATS / "judged.mcap")
        print(check_rerun(path))


if __name__ == "__main__":
    main()
