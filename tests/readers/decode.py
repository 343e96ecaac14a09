"""Decodes every message of a recording with two independent libraries, and writes the values.

    decode.py RECORDING DIRECTORY

Writes one file per library and topic: every field of every message in the order of the schema, each value packed again as
8 little-endian bytes. The test compares these files bit for bit with what was published.
"""

import re
import struct
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

FIELD = re.compile(r"^(uint64|float64)(?:\[(\d+)\])? (\w+)$")


def fields(schema):
    """Returns name, struct code and count of every field of a schema."""
    lines = [line for line in schema.splitlines() if line and not line.startswith("#")]
    matches = [FIELD.match(line) for line in lines]
    return [(m[3], {"uint64": "Q", "float64": "d"}[m[1]], int(m[2] or 0)) for m in matches]


def packed(message, layout):
    words = []
    for name, code, count in layout:
        value = getattr(message, name)
        values = list(value) if count else [value]
        assert len(values) == max(count, 1), (name, values)
        words += [struct.pack("<" + code, number) for number in values]
    return b"".join(words)


def by_mcap(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_summary() is not None, "the file has no index"
        last = 0
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert message.log_time >= last, "messages are not in the order of receipt"
            assert message.sequence == decoded.tick
            last = message.log_time
            yield channel.topic, packed(decoded, fields(schema.data.decode()))


def by_rosbags(path):
    with AnyReader([Path(path)]) as reader:
        for connection, _, raw in reader.messages():
            decoded = reader.deserialize(raw, connection.msgtype)
            yield connection.topic, packed(decoded, fields(connection.msgdef.data))


def main():
    recording, directory = sys.argv[1], Path(sys.argv[2])
    for name, read in (("mcap", by_mcap), ("rosbags", by_rosbags)):
        topics = {}
        for topic, message in read(recording):
            topics.setdefault(topic, []).append(message)
        for topic, messages in topics.items():
            file = directory / (name + topic.replace("/", "."))
            file.write_bytes(b"".join(messages))
        print(name, sum(map(len, topics.values())), len(topics))


if __name__ == "__main__":
    main()
