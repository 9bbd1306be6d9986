"""A MAVLink peer in a process of its own, made of pymavlink: plays the autopilot.

Prints one JSON object a line: first where it can be reached, then every message that it gets.
"""

import argparse
import contextlib
import json
import math
import os
import threading
import time
from typing import Any

from pymavlink import mavutil

mavlink = mavutil.mavlink


class PtyPeer(mavutil.mavfile):
    """The far end of a serial line."""

    def __init__(self, link: str, **ids: int) -> None:
        # Windows has neither; the peer's other addresses work there.
        import pty
        import tty

        self.far, self.near = pty.openpty()
        tty.setraw(self.near)
        os.set_blocking(self.far, False)
        if os.path.lexists(link):
            os.unlink(link)
        os.symlink(os.ttyname(self.near), link)
        # The near end stays open here too: without anyone there, reading the far end is an error.
        super().__init__(self.far, link, **ids)

    def recv(self, _n: int | None = None) -> bytes:
        try:
            return os.read(self.far, 4096)
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self.far, data)


def connect(url: str, system: int) -> mavutil.mavfile:
    ids = {"source_system": system, "source_component": 1}
    if url.startswith("pty:"):
        return PtyPeer(url.removeprefix("pty:"), **ids)
    return mavutil.mavlink_connection(url, **ids)


def port_of(link: mavutil.mavfile) -> int:
    if isinstance(link, PtyPeer):
        return 0
    made = link.listen if isinstance(link, mavutil.mavtcpin) else link.port
    return int(made.getsockname()[1])


def say(**what: object) -> None:
    print(json.dumps(what), flush=True)


def heard(link: mavutil.mavfile, message: Any) -> None:
    fields = {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in message.to_dict().items()
    }
    frame = message.get_msgbuf()
    say(
        fields=fields,
        magic=frame[0],
        seq=message.get_seq(),
        system=message.get_srcSystem(),
        component=message.get_srcComponent(),
        at_ns=time.monotonic_ns(),
    )


def die_with_parent() -> None:
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("--system", type=int, default=1)
    parser.add_argument("--type", type=int, default=mavlink.MAV_TYPE_SUBMARINE)
    parser.add_argument("--autopilot", type=int, default=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)
    parser.add_argument("--garbage", action="store_true")
    args = parser.parse_args()
    threading.Thread(target=die_with_parent, daemon=True).start()
    link = connect(args.url, args.system)
    say(port=port_of(link))
    noise, beat_s = os.urandom, 0.0
    while True:
        message = link.recv_msg()
        if message is not None and message.get_type() != "BAD_DATA":
            heard(link, message)
        if time.monotonic() > beat_s:
            beat_s = time.monotonic() + 0.1
            if args.garbage:
                link.write(noise(300) + b"\xfd\x09\x00\x00" + noise(20))
            link.mav.heartbeat_send(args.type, args.autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE)
            link.mav.attitude_send(5, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
        if message is None:
            time.sleep(0.002)


if __name__ == "__main__":
    main()
