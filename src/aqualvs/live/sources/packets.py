"""Packets for a decoder, made from bytes that came some other way than through FFmpeg."""

from typing import cast

from av.packet import Packet
from av.video.stream import VideoStream


def packet_with(data: bytes) -> "Packet[VideoStream]":
    """Return a packet with a copy of `data`.

    Decoders read a few dozen bytes beyond a packet's end and count on zeros there
    (AV_INPUT_BUFFER_PADDING_SIZE of FFmpeg). Memory that FFmpeg allocates has them; Python's bytes
    end where they end, so that a sound picture may be taken for damaged.

    Parameters
    ----------
    data : bytes
        One coded picture.
    """
    packet = cast("Packet[VideoStream]", Packet(len(data)))
    packet.update(data)
    return packet
