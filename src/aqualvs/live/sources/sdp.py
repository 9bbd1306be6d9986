"""Session descriptions (RFC 8866) of RTP streams."""

import base64
import binascii
import re
from dataclasses import dataclass
from pathlib import Path

from aqualvs.errors import SourceError
from aqualvs.live.sources.datagrams import UdpAddress
from aqualvs.live.sources.h264 import START_CODE
from aqualvs.special_files import refuse_special

_MAX_BYTES = 64 << 10


@dataclass(frozen=True, slots=True)
class SdpVideo:
    """The video that a session description announces.

    Attributes
    ----------
    address : UdpAddress
        Where it arrives; the host is kept for multicast only.
    payload_type : int
    codec : str
        As in RTP, upper case: "H264".
    parameter_sets : bytes
        SPS and PPS of H.264 as a byte stream; empty if they come in the stream.
    """

    address: UdpAddress
    payload_type: int
    codec: str
    parameter_sets: bytes


def read_sdp(path: Path) -> SdpVideo:
    """Read the first video from an SDP file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    SourceError
        If the file cannot be read or announces no video over RTP and UDP.
    """
    refuse_special(path)
    try:
        text = path.read_bytes()[:_MAX_BYTES].decode("utf-8", "replace")
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror})") from fault
    session, *media = re.split(r"^(?=m=)", text, flags=re.MULTILINE)
    for part in media:
        found = re.match(r"m=video (\d+)(?:/\d+)? RTP/AVPF? (\d+)", part)
        if found:
            port, payload_type = int(found[1]), int(found[2])
            return SdpVideo(
                UdpAddress(_group(part) or _group(session), port),
                payload_type,
                _codec(part, payload_type),
                _parameter_sets(part, payload_type),
            )
    raise SourceError(
        f"{path}: announces no video over RTP; it needs a line m=video PORT RTP/AVP 96"
    )


def _group(part: str) -> str:
    """Return the multicast group of the connection line; empty for the vehicle's own address."""
    found = re.search(r"^c=IN IP[46] ([^/\s]+)", part, re.MULTILINE)
    host = found[1] if found else ""
    first = host.partition(".")[0]
    is_group = host.lower().startswith("ff") or (first.isdecimal() and 224 <= int(first) <= 239)
    return host if is_group else ""


def _codec(part: str, payload_type: int) -> str:
    found = re.search(rf"^a=rtpmap:{payload_type} ([^/\s]+)/", part, re.MULTILINE)
    return found[1].upper() if found else "unknown"


def _parameter_sets(part: str, payload_type: int) -> bytes:
    found = re.search(
        rf"^a=fmtp:{payload_type} .*sprop-parameter-sets=([^;\s]+)", part, re.MULTILINE
    )
    if not found:
        return b""
    try:
        sets = [base64.b64decode(text, validate=True) for text in found[1].split(",") if text]
    except binascii.Error:
        return b""
    return b"".join(START_CODE + each for each in sets)
