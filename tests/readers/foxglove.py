"""A client of a Foxglove WebSocket with the protocol foxglove.sdk.v1.

    foxglove.py URL DIRECTORY [--stall]

Subscribes to every channel, writes the advertised channels to DIRECTORY/channels.json, and receives messages until the server
closes. Writes the messages of channel N to DIRECTORY/N: for each the log time and the length as little-endian u64, then the
payload. Decodes every payload with an independent library by the advertised schema; the decoded values, packed again, must
equal the payload. With --stall the client never reads, and its receive buffer is tiny.
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


def open_client(url, stall):
    """Connects, with a tiny receive buffer if stalled."""
    address = urlsplit(url)
    connection = socket.socket()
    if stall:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect((address.hostname, address.port))
    return connect(url, sock=connection, subprotocols=["foxglove.sdk.v1"], compression=None, max_size=None, max_queue=1)


def subscribe(client):
    """Subscribes to every channel, with the channel's number as that of the subscription. Returns the channels."""
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
    """Yields channel, log time and payload of every message until the server closes."""
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
    client = open_client(url, stall)
    channels = subscribe(client)
    directory.mkdir()
    decoders = {channel["id"]: decoder(channel) for channel in channels}
    files = {channel["id"]: open(directory / str(channel["id"]), "wb") for channel in channels}
    # The test waits for this file, which must not appear before it is complete.
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
