"""Takes part in a run that is shown on a Foxglove WebSocket, as the protocol foxglove.sdk.v1 has it.

    foxglove.py URL DIRECTORY [--stall]

Subscribes every channel, writes what was advertised to DIRECTORY/channels.json, and takes messages until the server goes. Then
channel N's are in DIRECTORY/N: for each the log time and the length as little-endian u64, and the payload. Every payload is
decoded with a library that knows nothing of corotate, by the schema that was advertised; what that found, packed again, must be
the payload. With --stall the client never reads what it has subscribed, and has next to no room for it.
"""

import json
import socket
import struct
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from decode import fields, packed

MESSAGE = 1
CDR_HEADER = b"\x00\x01\x00\x00"


def opened(url, stall):
    """A connection with a little room, or with that which the system gives."""
    address = urlsplit(url)
    plug = socket.socket()
    if stall:
        plug.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    plug.connect((address.hostname, address.port))
    return connect(url, sock=plug, subprotocols=["foxglove.sdk.v1"], compression=None, max_size=None, max_queue=1)


def subscribed(client):
    """Subscribes every channel; a subscription has its channel's number."""
    info = json.loads(client.recv())
    assert info["op"] == "serverInfo" and info["capabilities"] == [], info
    advertised = json.loads(client.recv())
    assert advertised["op"] == "advertise", advertised
    wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in advertised["channels"]]
    client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return advertised["channels"]


def decoder(channel):
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg"), channel
    schema = Schema(channel["id"], channel["schema"].encode(), "ros2msg", channel["schemaName"])
    return DecoderFactory().decoder_for("cdr", schema), fields(channel["schema"])


def messages(client):
    """Channel, log time and payload of every message, until the server goes."""
    try:
        while True:
            message = client.recv()
            assert isinstance(message, bytes) and message[0] == MESSAGE, message
            channel, log_time = struct.unpack_from("<IQ", message, 1)
            yield channel, log_time, message[13:]
    except ConnectionClosed:
        pass


def main():
    url, directory, stall = sys.argv[1], Path(sys.argv[2]), "--stall" in sys.argv
    client = opened(url, stall)
    channels = subscribed(client)
    directory.mkdir()
    decoders = {channel["id"]: decoder(channel) for channel in channels}
    files = {channel["id"]: open(directory / str(channel["id"]), "wb") for channel in channels}
    # Whoever waits for this file finds it whole.
    part = directory / "channels.part"
    part.write_text(json.dumps(channels))
    part.rename(directory / "channels.json")
    while stall:
        time.sleep(1)
    for channel, log_time, payload in messages(client):
        files[channel].write(struct.pack("<QQ", log_time, len(payload)) + payload)
        decode, layout = decoders[channel]
        assert CDR_HEADER + packed(decode(payload), layout) == payload, (channel, payload)


main()
