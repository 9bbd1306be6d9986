"""The pilot's page in a real browser, and what it refuses."""

import asyncio
import contextlib
import json
import socket
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from aqualvs.control.vehicle import Setpoint, SetpointHolder, VehicleState
from aqualvs.errors import OptionError
from aqualvs.live.dashboard.access import (
    MAX_MESSAGE_BYTES,
    Access,
    ConnectionLimits,
    Controls,
    RecordButton,
    TokenGate,
    make_access,
)
from aqualvs.live.dashboard.server import Dashboard, DashboardServer, Hub, PageClient, page_picture
from aqualvs.live.options import host_and_port
from aqualvs.recording import RecorderSwitch
from aqualvs.recording.sample import LiveSample
from aqualvs.results.folder import POSTURE_COLUMNS, posture_row
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.sources.base import PartHealth, State
from browser import Page, open_page
from live_cases import demo_rig, demo_samples, of_size
from waiting import TIMEOUT_S, until

TOKEN = "let me steer"


@dataclass
class Button:
    """Stands for a recorder."""

    on: bool = False
    pressed: list[bool] = field(default_factory=list)

    def start(self) -> None:
        self.on = True
        self.pressed.append(True)

    def stop(self) -> None:
        self.on = False
        self.pressed.append(False)

    def to_dict(self) -> dict[str, Any]:
        return {"on": self.on, "words": "dive.mcap" if self.on else ""}


@dataclass
class Bench:
    server: DashboardServer
    dashboard: Dashboard
    controls: Controls
    button: Button

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.server.port}"

    @contextlib.contextmanager
    def connect(self, token: str = "") -> Iterator[ClientConnection]:
        with connect(f"ws://{self.address}/live", max_size=None) as connection:
            connection.send(json.dumps({"kind": "hello", "token": token}))
            yield connection

    def play(self, n: int = 10) -> None:
        """Send so many samples."""
        for i in range(n):
            self.dashboard.send(demo_samples(4)[i % 4])
            time.sleep(0.03)

    def shown(self, connection: ClientConnection, sample: LiveSample | None = None) -> Any:
        """Send a sample until a page is told the state, which the server may let in later."""
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            self.dashboard.send(sample or demo_samples(1)[0])
            with contextlib.suppress(TimeoutError):
                return state_of(connection, 0.2)
        raise AssertionError("no state comes")


@pytest.fixture
def bench() -> Iterator[Bench]:
    rig, button = demo_rig(), Button()
    controls = Controls(SetpointHolder(rig.working_range, followed=False), button)
    server = DashboardServer("127.0.0.1", 0, Access("127.0.0.1", TOKEN), rig, controls)
    place = VehicleState(depth=4.87, heading=1.0)
    dashboard = Dashboard(server, controls, lambda: place)
    yield Bench(server, dashboard, controls, button)
    dashboard.close()


def state_of(connection: ClientConnection, timeout_s: float) -> dict[str, Any]:
    while True:
        message = connection.recv(timeout=timeout_s)
        if isinstance(message, str) and (found := json.loads(message))["kind"] == "state":
            return dict(found)


@contextlib.contextmanager
def playing(bench: Bench) -> Iterator[Callable[[LiveSample], None]]:
    """Send a sample over and over; yields what changes it."""
    stop, current = threading.Event(), [demo_samples(1)[0]]

    def play() -> None:
        while not stop.wait(0.05):
            bench.dashboard.send(current[0])

    player = threading.Thread(target=play)
    player.start()
    try:
        yield lambda sample: current.__setitem__(0, sample)
    finally:
        stop.set()
        player.join()


def test_in_a_browser_it_shows_what_posture_csv_says_and_takes_commands(
    bench: Bench, tmp_path: Path
) -> None:
    sample = demo_samples(4)[3]
    # Only one frame, so that what is on the screen can be compared.
    with playing(bench) as show:
        show(sample)
        with open_page(tmp_path / "profile") as page:
            page.size(1280, 800)
            page.call("Page.navigate", url=f"http://{bench.address}/#token={TOKEN}")
            page.wait_for("document.getElementById('numbers').dataset.valid === '1'")
            shown = page.evaluate("({...document.getElementById('numbers').dataset})")
            row = dict(zip(POSTURE_COLUMNS, posture_row(sample.scan).split(","), strict=True))
            assert shown["frame"] == row["frame"]
            assert shown["range"] == row["range_m"]
            assert shown["yaw"] == row["yaw_deg"]
            assert shown["pitch"] == row["pitch_deg"]
            assert page.evaluate("document.getElementById('range').textContent") == (
                f"{float(row['range_m']):.3f}"
            )
            # The token has left the address bar, where screen recordings would show it.
            assert page.evaluate("location.hash") == ""
            page.evaluate("document.getElementById('record').click()")
            page.wait_for("document.getElementById('record').textContent === 'Stop recording'")
            page.evaluate("document.getElementById('set-range').value = '0.55'")
            page.evaluate("document.getElementById('setpoint').requestSubmit()")
            page.wait_for("document.getElementById('set-words').textContent.includes('0.55')")
            page.wait_for(
                "document.getElementById('video').getContext('2d')"
                ".getImageData(300, 200, 1, 1).data[1] > 0"
            )
            assert_guided(page, row)
            for width in (1280, 390):
                page.size(width, 768)
                page.wait_for("document.documentElement.scrollWidth <= innerWidth")
            page.size(1366, 768)
            # All that a pilot needs fits a small laptop's screen.
            page.wait_for("document.documentElement.scrollHeight <= innerHeight")
            page.screenshot(tmp_path / "page.png")
            assert (tmp_path / "page.png").stat().st_size > 30_000
            assert page.said == []
    assert bench.button.pressed == [True]
    assert bench.controls.setpoint.setpoint == Setpoint(0.55, 0.0)


def assert_guided(page: Page, row: dict[str, str]) -> None:
    """The page says how far to go and to turn from a setpoint of 0.55 m, and where the vehicle is.

    A net whose far normal points to the right is squared by a turn to the right.
    """

    def text(name: str) -> str:
        return str(page.evaluate(f"document.getElementById('{name}').textContent"))

    off, turn = float(row["range_m"]) - 0.55, float(row["yaw_deg"])
    assert (off > 0.1, turn > 10.0) == (True, True)
    assert text("error-range") == f"▲ {off:.2f} m too far"
    assert (text("turn"), text("error-yaw")) == (f"{turn:.0f}° ▶", "turn right")
    assert (text("depth"), text("heading")) == ("4.87", "057")
    # Nothing follows this setpoint: it is an aim.
    assert text("set-name") == "Aim at"
    assert text("set-words").startswith("Aim: 0.55 m")
    assert "Hold" not in str(page.evaluate("document.body.innerText"))


def test_a_browser_warns_of_a_near_net_and_greys_lasers_without_pictures(
    bench: Bench, tmp_path: Path
) -> None:
    sample = demo_samples(1)[0]
    posture = sample.scan.posture
    assert isinstance(posture, Posture)
    lasers = (PartHealth("lower", State.OK),)
    seen = replace(sample, health=replace(sample.health, lasers=lasers))
    near = replace(seen, scan=replace(seen.scan, posture=replace(posture, nearest=0.33)))
    refusal = Refusal(Reason.NO_FRAMES, "no picture for 2 s")
    blind = replace(near, scan=replace(seen.scan, posture=refusal), frame=None)
    chip = "document.querySelector('#parts li:nth-child(2)').dataset.state === '{}'"
    with open_page(tmp_path / "profile") as page, playing(bench) as show:
        show(near)
        page.call("Page.navigate", url=f"http://{bench.address}/")
        page.wait_for("document.getElementById('box-range').dataset.level === 'bad'")
        page.wait_for(chip.format("ok"))
        parts = page.evaluate("document.getElementById('parts').innerText")
        assert "laser lower" in str(parts)
        show(blind)
        page.wait_for(chip.format("off"))


def test_time_and_room_of_a_recording_are_told(tmp_path: Path) -> None:
    switch = RecorderSwitch(tmp_path)
    button = RecordButton(switch)
    assert button.to_dict() == {"on": False, "words": ""}
    button.start()
    told = button.to_dict()
    button.stop()
    assert told["on"]
    assert str(told["words"]).endswith(".mcap")
    assert 0.0 <= float(told["seconds"]) < TIMEOUT_S
    assert int(told["free_bytes"]) > 0
    assert button.to_dict()["on"] is False


def test_without_a_token_this_machine_may_watch_but_not_command(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    with bench.connect() as connection:
        assert json.loads(connection.recv(timeout=TIMEOUT_S))["may_command"] is False
        assert bench.shown(connection)["posture"]["valid"] == "1"
        connection.send(json.dumps({"kind": "record", "on": True}))
        answer = ""
        while "refused" not in answer:
            message = connection.recv(timeout=TIMEOUT_S)
            answer = message if isinstance(message, str) else ""
    assert bench.button.pressed == []
    assert "record refused" in caplog.text


def test_elsewhere_nothing_is_shown_without_the_token() -> None:
    rig = demo_rig()
    controls = Controls(SetpointHolder(rig.working_range), Button())
    server = DashboardServer("127.0.0.1", 0, Access("0.0.0.0", TOKEN), rig, controls)
    try:
        for token, why in (("", "no token"), ("guess", "wrong token")):
            with connect(f"ws://127.0.0.1:{server.port}/live") as connection:
                connection.send(json.dumps({"kind": "hello", "token": token}))
                with pytest.raises(ConnectionClosed) as closed:
                    connection.recv(timeout=TIMEOUT_S)
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.reason == why
        with connect(f"ws://127.0.0.1:{server.port}/live") as connection:
            connection.send(json.dumps({"kind": "hello", "token": TOKEN}))
            assert json.loads(connection.recv(timeout=TIMEOUT_S))["may_command"] is True
    finally:
        server.close()


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}],
    ids=["foreign page", "page without origin", "foreign name for this machine"],
)
def test_foreign_pages_are_refused(bench: Bench, headers: dict[str, str]) -> None:
    name = headers.get("Host", "127.0.0.1")
    wire = socket.create_connection(("127.0.0.1", bench.server.port))
    origin: Any = headers.get("Origin")
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{name}:{bench.server.port}/live", sock=wire, origin=origin)
    assert refused.value.response.status_code == 403


def receive_until_closed(connection: ClientConnection) -> None:
    while True:
        connection.recv(timeout=TIMEOUT_S)


@pytest.mark.parametrize(
    "message",
    [
        "not json",
        "{}",
        '{"kind":"arm"}',
        '{"kind":"record","on":"yes"}',
        '{"kind":"record","on":true,"also":1}',
        '{"kind":"setpoint","range_m":1e999}',
        "[" * 500,
        b"\x00\x01",
    ],
)
def test_malformed_messages_end_the_connection_and_nothing_else(
    bench: Bench, message: str | bytes
) -> None:
    with bench.connect(TOKEN) as bad, bench.connect(TOKEN) as good:
        bad.recv(timeout=TIMEOUT_S)
        good.recv(timeout=TIMEOUT_S)
        bad.send(message)
        with pytest.raises(ConnectionClosed):
            receive_until_closed(bad)
        assert bench.shown(good)["posture"]["valid"] == "1"
    assert bench.button.pressed == []
    assert bench.controls.setpoint.setpoint is None


def test_oversized_messages_end_the_connection(bench: Bench) -> None:
    with bench.connect(TOKEN) as connection:
        connection.recv(timeout=TIMEOUT_S)
        connection.send("x" * (MAX_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed) as closed:
            connection.recv(timeout=TIMEOUT_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009


def test_who_says_nothing_is_not_let_in(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aqualvs.live.dashboard.server._HELLO_S", 0.2)
    with connect(f"ws://{bench.address}/live") as connection, pytest.raises(ConnectionClosed):
        connection.recv(timeout=TIMEOUT_S)


def test_a_setpoint_that_cannot_be_held_is_refused(bench: Bench) -> None:
    with bench.connect(TOKEN) as connection:
        connection.recv(timeout=TIMEOUT_S)
        connection.send(json.dumps({"kind": "setpoint", "range_m": 5.0}))
        answer = json.loads(connection.recv(timeout=TIMEOUT_S))
        assert answer["kind"] == "refused"
        assert "5 m" in answer["why"]
        connection.send(json.dumps({"kind": "setpoint", "range_m": 0.6, "yaw_deg": 80.0}))
        assert "80" in json.loads(connection.recv(timeout=TIMEOUT_S))["why"]
    assert bench.controls.setpoint.setpoint is None


def test_a_page_that_goes_leaves_nothing_behind(bench: Bench) -> None:
    for _ in range(3 * Hub.MAX_VIEWERS):
        with bench.connect() as connection:
            connection.recv(timeout=TIMEOUT_S)
            # As a browser that crashes: without saying good-bye.
            connection.socket.close()
        bench.play(3)
    until(lambda: bench.play(1) or not bench.server.hub.n_viewers, "an empty server")


def test_too_many_pages_are_refused(bench: Bench) -> None:
    with contextlib.ExitStack() as open_:
        for _ in range(Hub.MAX_VIEWERS):
            open_.enter_context(bench.connect()).recv(timeout=TIMEOUT_S)
        late = open_.enter_context(bench.connect())
        with pytest.raises(ConnectionClosed):
            late.recv(timeout=TIMEOUT_S)


def test_a_slow_page_gets_the_latest_and_few_pictures() -> None:
    async def scene() -> tuple[list[str | None], list[bytes | None]]:
        viewer = PageClient(may_command=False)
        for i in range(10):
            viewer.put(f"{i}", bytes([i]))
        got = [await viewer.next()]
        viewer.put("10", bytes([10]))
        got.append(await viewer.next())
        # Two pictures are on their way: none more until one has been shown.
        viewer.put("11", bytes([11]))
        got.append(await viewer.next())
        viewer.shown()
        got.append(await viewer.next())
        return [state for state, _ in got], [picture for _, picture in got]

    states, pictures = asyncio.run(scene())
    assert states == ["9", "10", "11", None]
    assert pictures == [b"\x09", b"\x0a", None, b"\x0b"]


def test_an_address_in_use_is_told_in_one_line(bench: Bench) -> None:
    with pytest.raises(OptionError, match="choose another address"):
        DashboardServer(
            "127.0.0.1", bench.server.port, make_access("127.0.0.1", None), demo_rig(),
            bench.controls,
        )  # fmt: skip


def test_tokens_are_made_long_and_checked() -> None:
    assert make_access("127.0.0.1", None).token != make_access("127.0.0.1", None).token
    assert len(make_access("127.0.0.1", None).token) >= 12
    assert make_access("127.0.0.1", "long enough").token == "long enough"
    with pytest.raises(OptionError, match="--token"):
        make_access("127.0.0.1", "short")
    assert Access("::1", TOKEN).is_local
    assert Access("localhost", TOKEN).is_local
    assert not Access("192.0.2.7", TOKEN).is_local
    assert not Access("boat", TOKEN).is_local


def test_addresses() -> None:
    assert host_and_port("", 8100, "--x") == ("127.0.0.1", 8100)
    assert host_and_port(":9000", 8100, "--x") == ("127.0.0.1", 9000)
    assert host_and_port("0.0.0.0", 8100, "--x") == ("0.0.0.0", 8100)
    assert host_and_port("[::1]:81", 8100, "--x") == ("::1", 81)
    with pytest.raises(OptionError, match="port"):
        host_and_port("boat:99999", 8100, "--x")


def test_pictures_are_small_jpegs() -> None:
    large = page_picture(of_size(1920, 1080, 0))
    assert large.startswith(b"\xff\xd8")
    sample = demo_samples(1)[0]
    assert sample.frame is not None
    assert len(page_picture(sample.frame)) < 120_000


def test_what_is_no_number_becomes_null(bench: Bench) -> None:
    silent = demo_samples(1)[0]
    silent = replace(silent, health=replace(silent.health, quality=float("nan")))
    with bench.connect() as connection:
        connection.recv(timeout=TIMEOUT_S)
        assert bench.shown(connection, silent)["health"]["quality"] is None


def raw(bench: Bench) -> socket.socket:
    return socket.create_connection(("127.0.0.1", bench.server.port), timeout=TIMEOUT_S)


def first_line(wire: socket.socket, *lines: str) -> str:
    """Send a request and return the first line of its answer."""
    wire.sendall("".join(f"{line}\r\n" for line in (*lines, "")).encode("latin-1"))
    answer = b""
    while b"\r\n" not in answer and (part := wire.recv(4096)):
        answer += part
    return answer.split(b"\r\n")[0].decode("latin-1")


UPGRADE = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)


@pytest.mark.parametrize("path", ["/", "/live", "/register_service"])
@pytest.mark.parametrize(
    "lines",
    [
        ("Host: [",),
        ("Host: [::1",),
        ("Host: ::1]:80",),
        ("Host: a b",),
        ("Host: 127.0.0.1:99999",),
        ("Host: 127.0.0.1:port",),
        ("Host: user@127.0.0.1",),
        ("Host: 127.0.0.1/path",),
        ("Host: \xff\xfe",),
        ("Host: 127.0.0.1", "Origin: http://["),
        ("Host: 127.0.0.1", "Origin: 127.0.0.1"),
        ("Host: 127.0.0.1", "Origin: http://127.0.0.1:1e3"),
        ("Host: 127.0.0.1", "Origin: http://127.0.0.1/page"),
        ("Host: 127.0.0.1", "Origin: http://127.0.0.1", "Origin: http://evil.example"),
    ],
    ids=str,
)
def test_malformed_addresses_are_a_bad_request(
    bench: Bench, path: str, lines: tuple[str, ...]
) -> None:
    upgrade = UPGRADE if path == "/live" else ()
    with raw(bench) as wire:
        answer = first_line(wire, f"GET {path} HTTP/1.1", *lines, *upgrade)
    assert answer.split()[1:2] == ["400"], answer


def test_idle_connections_of_strangers_leave_room_for_the_pilot(bench: Bench) -> None:
    with contextlib.ExitStack() as open_:
        for _ in range(60):
            open_.enter_context(raw(bench))
        for _ in range(20):
            trickling = open_.enter_context(raw(bench))
            with contextlib.suppress(OSError):
                trickling.sendall(b"GET / HTTP/1.1\r\nHo")
        with raw(bench) as wire:
            assert first_line(wire, "GET / HTTP/1.1", "Host: boat").endswith("200 OK")
        with bench.connect(TOKEN) as page:
            assert json.loads(page.recv(timeout=TIMEOUT_S))["may_command"] is True


def test_one_address_holds_few_connections_without_a_greeting(bench: Bench) -> None:
    with contextlib.ExitStack() as open_:
        page = open_.enter_context(bench.connect(TOKEN))
        page.recv(timeout=TIMEOUT_S)
        first = open_.enter_context(raw(bench))
        for _ in range(ConnectionLimits.PER_ADDRESS):
            open_.enter_context(raw(bench))
        first.settimeout(10.0)
        with contextlib.suppress(ConnectionResetError):
            assert first.recv(1) == b""
        # Whoever has greeted stays.
        assert bench.shown(page)["posture"]["valid"] == "1"


def test_who_never_asks_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ConnectionLimits, "SILENCE_S", 0.3)
    rig = demo_rig()
    controls = Controls(SetpointHolder(rig.working_range), Button())
    server = DashboardServer("127.0.0.1", 0, Access("127.0.0.1", TOKEN), rig, controls)
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=TIMEOUT_S) as wire:
            wire.sendall(b"GET / HTTP/1.1\r\nHost: 127")
            with contextlib.suppress(ConnectionResetError):
                assert wire.recv(1) == b""
    finally:
        server.close()


def test_wrong_tokens_cost_time_over_all_connections(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TokenGate, "WRONG_S", 0.3)
    n_guesses = 6
    begin = time.monotonic()
    with contextlib.ExitStack() as open_:
        guessing = [open_.enter_context(bench.connect(f"guess {i}")) for i in range(n_guesses)]
        # The pilot's own token waits for its turn at most.
        with bench.connect(TOKEN) as page:
            assert json.loads(page.recv(timeout=TIMEOUT_S))["may_command"] is True
        for connection in guessing:
            with pytest.raises(ConnectionClosed):
                connection.recv(timeout=TIMEOUT_S)
    assert time.monotonic() - begin >= n_guesses * 0.3


def test_addresses_without_wrong_tokens_are_asked_first() -> None:
    async def scene() -> list[str]:
        gate, order = TokenGate(Access("0.0.0.0", TOKEN)), []

        async def ask(address: str, token: str) -> None:
            await gate.check(address, token)
            order.append(address)

        await gate.check("192.0.2.66", "guess")
        await asyncio.gather(
            *(ask("192.0.2.66", f"guess {i}") for i in range(4)), ask("192.0.2.1", TOKEN)
        )
        return order

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TokenGate, "WRONG_S", 0.01)
        order = asyncio.run(scene())
    assert order.index("192.0.2.1") <= 1


def test_a_page_with_the_token_takes_the_place_of_one_without(bench: Bench) -> None:
    with contextlib.ExitStack() as open_:
        pages = [open_.enter_context(bench.connect()) for _ in range(Hub.MAX_VIEWERS)]
        for page in pages:
            page.recv(timeout=TIMEOUT_S)
        pilot = open_.enter_context(bench.connect(TOKEN))
        assert json.loads(pilot.recv(timeout=TIMEOUT_S))["may_command"] is True
        with pytest.raises(ConnectionClosed) as closed:
            receive_until_closed(pages[0])
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.reason == "a page with the token took this place"
        assert bench.shown(pages[1])["posture"]["valid"] == "1"


@pytest.mark.parametrize(
    ("embedders", "ancestors"),
    [
        ((), "'none'"),
        (("http://blueos.local", "http://[::1]:81"), "http://blueos.local http://[::1]:81"),
    ],
)
def test_only_named_origins_may_show_the_page(embedders: tuple[str, ...], ancestors: str) -> None:
    rig = demo_rig()
    controls = Controls(SetpointHolder(rig.working_range, followed=False), Button())
    access = make_access("127.0.0.1", TOKEN, embedders)
    server = DashboardServer("127.0.0.1", 0, access, rig, controls)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/") as answer:
            policy = answer.headers["Content-Security-Policy"]
    finally:
        server.close()
    assert policy.endswith(f"frame-ancestors {ancestors}")


@pytest.mark.parametrize(
    "origin", ["*", "http://*", "blueos.local", "http://a.b/page", "http://a; script-src *", "null"]
)
def test_what_is_no_origin_may_not_show_the_page(origin: str) -> None:
    with pytest.raises(OptionError, match="--embed-from") as caught:
        make_access("127.0.0.1", TOKEN, [origin])
    assert "\n" not in str(caught.value)
