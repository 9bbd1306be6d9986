"""The pilot's page as an output: its web server, and the state and pictures that it sends.

`Hub` hands the latest state and picture to every open page; slow pages skip some.
"""

import asyncio
import importlib.resources
import json
import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import cv2
import numpy as np
import uvicorn
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from aqualvs import __version__
from aqualvs.control.time_filter import FilteredPosture
from aqualvs.control.vehicle import Setpoint, VehicleState
from aqualvs.errors import AqualvsError, OptionError
from aqualvs.live.dashboard.access import (
    MAX_MESSAGE_BYTES,
    MESSAGES,
    Access,
    ConnectionLimits,
    Controls,
    Hello,
    Peer,
    PictureShown,
    TokenGate,
    are_addresses,
)
from aqualvs.live.outputs.base import Output
from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import LiveSample
from aqualvs.results.files import without_nan
from aqualvs.results.folder import posture_cells
from aqualvs.scanning.posture import Refusal, deviations
from aqualvs.scanning.scan import Frame, ImagePlane, Label, ScanPoints
from aqualvs.sources.base import Health, PartHealth, State
from aqualvs.text import laser_colour


def page_state(
    sample: LiveSample,
    setpoint: Setpoint | None,
    recording: Mapping[str, Any],
    vehicle: VehicleState | None,
) -> str:
    """Return the message for the page about one sample.

    Its `posture` holds the cells of the frame's row in `posture.csv`, as they are written there.
    """
    posture = sample.scan.posture
    found = {
        "kind": "state",
        "utc_ms": sample.utc_ns // 10**6,
        "posture": posture_cells(sample.scan),
        "detail": posture.detail if isinstance(posture, Refusal) else "",
        "n_water": f"{sample.scan.n_water:.4f}",
        "filtered": _filtered(sample.filtered),
        "setpoint": None
        if setpoint is None
        else {"range_m": setpoint.range, "yaw_deg": math.degrees(setpoint.yaw)},
        "recording": recording,
        "vehicle": _vehicle(vehicle),
        "health": _health(sample.health),
        "points": _points(sample.scan.points),
    }
    return json.dumps(without_nan(found), separators=(",", ":"))


def rig_state(rig: Rig, *, may_command: bool, holds: bool) -> str:
    """Return the first message of a connection: the data that do not change."""
    found = {
        "kind": "rig",
        "name": rig.name,
        "size_px": rig.size_px,
        "lasers": [
            {"name": laser.name, "colour": laser_colour(i)} for i, laser in enumerate(rig.lasers)
        ],
        "working_range_m": rig.working_range,
        "may_command": may_command,
        "holds": holds,
    }
    return json.dumps(found, separators=(",", ":"))


def _points(points: ScanPoints) -> dict[str, Any]:
    """Return every so-many-th point: in the picture, and in metres from above and from the side."""
    max_points = 360
    step = max(1, math.ceil(len(points) / max_points))
    some = slice(None, None, step)
    xyz = np.round(points.points_in_dome[some], 3)
    pixels = np.round(points.pixels[some], 1)
    return {
        "laser": points.laser[some].tolist(),
        "u": pixels[:, 0].tolist(),
        "v": pixels[:, 1].tolist(),
        "x": xyz[:, 0].tolist(),
        "y": xyz[:, 1].tolist(),
        "z": xyz[:, 2].tolist(),
        "used": points.used[some].astype(int).tolist(),
        "net": (points.label[some] == Label.NET).astype(int).tolist(),
    }


def _vehicle(state: VehicleState | None) -> dict[str, float | None] | None:
    if state is None or (state.depth is None and state.heading is None):
        return None
    heading = None if state.heading is None else math.degrees(state.heading) % 360.0
    return {"depth_m": state.depth, "heading_deg": heading}


def _filtered(filtered: FilteredPosture | None) -> dict[str, float] | None:
    if filtered is None:
        return None
    return {
        "range_m": filtered.range,
        "pitch_deg": math.degrees(filtered.pitch),
        "yaw_deg": math.degrees(filtered.yaw),
        "sigma_range_m": deviations(filtered.total_covariance)[0],
        "age_s": filtered.age_s,
    }


def _health(health: Health) -> dict[str, Any]:
    return {
        "state": health.state.value,
        "rate_hz": round(health.rate_hz, 1),
        "valid_share": health.valid_share,
        "n_frames": health.n_frames,
        "n_dropped": health.n_dropped,
        "n_lost": health.n_lost,
        "quality": health.quality,
        "sigma_n_water": health.sigma_n_water,
        "delays_ms": {
            d.name: [round(1e3 * d.median_s, 2), round(1e3 * d.p99_s, 2)] for d in health.delays
        },
        "source": asdict(health.source),
        "lasers": [asdict(part) for part in health.lasers],
        "outputs": [asdict(part) for part in health.outputs],
    }


@dataclass(slots=True, eq=False)
class PageClient:
    """One page."""

    may_command: bool
    unshown: int = 0  # Pictures that were sent and not yet shown.
    # Set when another page takes this one's place.
    gone: asyncio.Event = field(default_factory=asyncio.Event)

    _state: str | None = None
    _picture: bytes | None = None
    _news: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, state: str, picture: bytes | None) -> None:
        """Replace the waiting state and picture by the latest."""
        self._state = state
        self._picture = picture if picture is not None else self._picture
        self._news.set()

    def shown(self) -> None:
        """Note that the page can take one picture more."""
        self.unshown = max(0, self.unshown - 1)
        self._news.set()

    async def next(self) -> tuple[str | None, bytes | None]:
        """Wait for news; returns a state and, where the page keeps up, a picture."""
        # Pictures sent to a page and not yet shown: one being drawn, one in transit.
        on_the_way = 2
        while True:
            await self._news.wait()
            self._news.clear()
            state, self._state = self._state, None
            picture = None
            if self._picture is not None and self.unshown < on_the_way:
                picture, self._picture = self._picture, None
                self.unshown += 1
            if state is not None or picture is not None:
                return state, picture


class Hub:
    """All pages; used from the server's event loop alone, but for `n_viewers`."""

    MAX_VIEWERS = 8

    def __init__(self) -> None:
        # In the order of their arrival.
        self._viewers: dict[PageClient, None] = {}

    @property
    def n_viewers(self) -> int:
        """Pages that are open."""
        return len(self._viewers)

    def join(self, viewer: PageClient) -> bool:
        """Add a page; False if there are too many.

        A page that may command takes the place of the oldest one that may not.
        """
        if len(self._viewers) >= self.MAX_VIEWERS:
            oldest = next((one for one in self._viewers if not one.may_command), None)
            if oldest is None or not viewer.may_command:
                return False
            self.leave(oldest)
            oldest.gone.set()
        self._viewers[viewer] = None
        return True

    def leave(self, viewer: PageClient) -> None:
        """Remove a page."""
        self._viewers.pop(viewer, None)

    def publish(self, state: str, picture: bytes | None) -> None:
        """Hand out the latest state, and picture if there is a new one."""
        for viewer in self._viewers:
            viewer.put(state, picture)


_OWN, _JS, _CSS = "aqualvs.live.dashboard", "text/javascript", "text/css"
# Name to file, type, and package: the colours are those of the reports.
_ASSETS = {
    "": ("dashboard.html", "text/html", _OWN),
    "colours.css": ("colours.css", _CSS, "aqualvs.report"),
    "dashboard.css": ("dashboard.css", _CSS, _OWN),
    "dashboard.js": ("dashboard.js", _JS, _OWN),
    "views.js": ("views.js", _JS, _OWN),
    "uPlot.iife.min.js": ("uPlot.iife.min.js", _JS, _OWN),
    "uPlot.min.css": ("uPlot.min.css", _CSS, _OWN),
}
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
# The first is the time limit for the greeting of a connected page.
_HELLO_S, _START_S, _STOP_S = 5.0, 10.0, 3.0
# Period of checks that a client whose token waits to be checked is still connected.
_ALIVE_S = 0.5
_REFUSED = 1008
_log = logging.getLogger(__name__)


class DashboardServer:
    """Server of page and data until it is closed.

    `port`: 0 takes any that is free. Raises `OptionError` if the address cannot be listened to.
    """

    def __init__(self, host: str, port: int, access: Access, rig: Rig, controls: Controls) -> None:
        self.hub = Hub()
        self._access, self._rig, self._controls = access, rig, controls
        embedders = " ".join(access.embedders) or "'none'"
        # What the page may load, and who may show it inside a page of theirs.
        policy = f"default-src 'self'; img-src 'self' blob: data:; frame-ancestors {embedders}"
        self._page_headers = {**_HEADERS, "Content-Security-Policy": policy}
        self._limits, self._gate = ConnectionLimits(), TokenGate(access)
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]  # Where it listens.
        self._loop: asyncio.AbstractEventLoop | None = None
        app = Starlette(
            routes=[
                Route("/register_service", _blueos, methods=["GET"]),
                Route("/{name:path}", self._asset, methods=["GET"]),
                WebSocketRoute("/live", self._serve_page),
            ]
        )
        self._server = uvicorn.Server(
            uvicorn.Config(
                _checked_addresses(app),
                http=self._limits.protocol(),
                log_level="warning",
                access_log=False,
                ws_max_size=MAX_MESSAGE_BYTES,
                ws_ping_interval=5.0,
                ws_ping_timeout=10.0,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve()), name="dashboard", daemon=True
        )
        self._thread.start()
        if not self._started():
            raise OptionError(f"dashboard: {host}:{self.port} did not start; try another port")

    def publish(self, state: str, picture: bytes | None) -> None:
        """Hand the latest to the pages; called from any thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self.hub.publish, state, picture)

    def close(self) -> None:
        """Close all connections and end the thread; further calls do nothing."""
        self._server.should_exit = True
        self._thread.join(_STOP_S)
        self._socket.close()

    def _started(self) -> bool:
        end = time.monotonic() + _START_S
        while self._thread.is_alive() and time.monotonic() < end:
            if self._server.started:
                return True
            time.sleep(0.01)
        return False

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        await self._server.serve(sockets=[self._socket])

    async def _asset(self, request: Request) -> Response:
        found = _ASSETS.get(request.path_params["name"])
        if found is None:
            return PlainTextResponse("no such page\n", 404, headers=_HEADERS)
        content = (importlib.resources.files(found[2]) / "assets" / found[0]).read_bytes()
        media_type = f"{found[1]}; charset=utf-8"
        return Response(content, media_type=media_type, headers=self._page_headers)

    async def _serve_page(self, socket: WebSocket) -> None:
        peer = socket.client.host if socket.client else "unknown"
        headers = socket.headers
        if not self._access.is_own_page(headers.get("origin"), headers.get("host", "")):
            _log.warning("dashboard: %s refused: foreign page %s", peer, headers.get("origin"))
            await socket.close(_REFUSED)
            return
        await socket.accept()
        try:
            viewer = await self._admit(socket, peer)
            if viewer is not None:
                await self._exchange(socket, viewer, peer)
        except (WebSocketDisconnect, RuntimeError, OSError):
            # The page has closed, which is normal.
            return

    async def _admit(self, socket: WebSocket, peer: str) -> PageClient | None:
        """Read the greeting; None if the page may not stay."""
        try:
            text = await asyncio.wait_for(socket.receive_text(), _HELLO_S)
            hello = MESSAGES.validate_json(text)
        except (TimeoutError, ValidationError, KeyError) as fault:
            await _refuse(socket, peer, f"no greeting: {type(fault).__name__}")
            return None
        token = hello.token if isinstance(hello, Hello) else ""
        known = bool(token) and await self._is_right(socket, token)
        viewer = PageClient(may_command=known)
        why = self._refusal(token, viewer)
        if why:
            await _refuse(socket, peer, why)
            return None
        self._limits.release(_peer_of(socket))
        await socket.send_text(
            rig_state(self._rig, may_command=known, holds=self._controls.setpoint.followed)
        )
        return viewer

    async def _is_right(self, socket: WebSocket, token: str) -> bool:
        """Return whether a token is right, when its turn has come; a page that goes loses it."""
        end = _peer_of(socket)
        asking = asyncio.create_task(self._gate.check(end[0], token))
        while self._limits.holds(end):
            done, _ = await asyncio.wait({asking}, timeout=_ALIVE_S)
            if done:
                return asking.result()
        asking.cancel()
        raise WebSocketDisconnect

    def _refusal(self, token: str, viewer: PageClient) -> str:
        """Let a page in, or return why not."""
        if token and not viewer.may_command:
            return "wrong token"
        if not self._access.may_watch(token):
            return "no token"
        return "" if self.hub.join(viewer) else "too many pages are open"

    async def _exchange(self, socket: WebSocket, viewer: PageClient, peer: str) -> None:
        """Send news and receive messages until the page closes."""
        tasks = [
            asyncio.create_task(_send_news(socket, viewer)),
            asyncio.create_task(_close_when_replaced(socket, viewer, peer)),
        ]
        try:
            while True:
                await self._handle(socket, viewer, peer, await socket.receive_text())
        except (ValidationError, KeyError):
            await _refuse(socket, peer, "message not understood")
        finally:
            self.hub.leave(viewer)
            for task in tasks:
                task.cancel()

    async def _handle(self, socket: WebSocket, viewer: PageClient, peer: str, text: str) -> None:
        message = MESSAGES.validate_json(text)
        if isinstance(message, PictureShown):
            viewer.shown()
        elif isinstance(message, Hello):
            return
        elif not viewer.may_command:
            _log.warning("dashboard: %s: %s refused: no token", peer, message.kind)
            await socket.send_json({"kind": "refused", "why": "open the page with its token"})
        else:
            try:
                await asyncio.to_thread(self._controls.carry_out, message)
                _log.info("dashboard: %s: %s", peer, message)
            except AqualvsError as fault:
                await socket.send_json({"kind": "refused", "why": str(fault)})


async def _send_news(socket: WebSocket, viewer: PageClient) -> None:
    while True:
        state, picture = await viewer.next()
        if state is not None:
            await socket.send_text(state)
        if picture is not None:
            await socket.send_bytes(picture)


async def _close_when_replaced(socket: WebSocket, viewer: PageClient, peer: str) -> None:
    await viewer.gone.wait()
    await _refuse(socket, peer, "a page with the token took this place")


async def _refuse(socket: WebSocket, peer: str, why: str) -> None:
    _log.warning("dashboard: %s refused: %s", peer, why)
    await socket.close(_REFUSED, why)


def _peer_of(socket: WebSocket) -> Peer:
    """Return address and port of a page."""
    return (socket.client.host, socket.client.port) if socket.client else ("unknown", 0)


def _checked_addresses(app: ASGIApp) -> ASGIApp:
    """Return an application that answers 400 where a request's addresses are malformed."""

    async def checked(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            headers = Headers(scope=scope)
            if not are_addresses(headers.getlist("host"), headers.getlist("origin")):
                answer = PlainTextResponse("malformed Host or Origin\n", 400, headers=_HEADERS)
                if scope["type"] == "websocket":
                    await WebSocket(scope, receive, send).send_denial_response(answer)
                else:
                    await answer(scope, receive, send)
                return
        await app(scope, receive, send)

    return checked


async def _blueos(_request: Request) -> Response:
    """Answer BlueOS, which asks every port for the service behind it."""
    return JSONResponse(
        {
            "name": "aqualvs",
            "description": "Range, pitch and yaw to a net or wall from laser lines.",
            "icon": "mdi-laser-pointer",
            "company": "aqualvs",
            "version": __version__,
            "webpage": "/",
            "api": "",
        },
        headers=_HEADERS,
    )


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as fault:
        listener.close()
        raise OptionError(
            f"--dashboard-address {host}:{port}: {fault.strerror}; choose another address"
        ) from fault
    listener.listen(16)
    return listener


def page_picture(frame: Frame) -> bytes:
    """Return the frame as a JPEG of at most 960 px width."""
    max_width, quality = 960, 70
    height, width = frame.luma.shape
    # Rows of a field are two rows apart.
    height = height if frame.field is None else 2 * height
    scale = min(1.0, max_width / width)
    # Even numbers: the colour planes have half the size.
    size = (2 * round(scale * width / 2), 2 * round(scale * height / 2))
    luma = _resized(frame.luma, size)
    if frame.chroma is None:
        image = luma
    else:
        half = (size[0] // 2, size[1] // 2)
        planes = [luma.ravel(), *(_resized(plane, half).ravel() for plane in frame.chroma)]
        stacked = np.concatenate(planes).reshape(size[1] * 3 // 2, size[0])
        image = np.asarray(cv2.cvtColor(stacked, cv2.COLOR_YUV2BGR_I420), np.uint8)
    done, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError("the picture could not be encoded")
    return bytes(code)


def _resized(plane: ImagePlane, size: tuple[int, int]) -> ImagePlane:
    if (plane.shape[1], plane.shape[0]) == size:
        return np.ascontiguousarray(plane)
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.uint8)


class Dashboard(Output):
    """Output to the open pages; costs next to nothing while there is none.

    `server`: owned from here on. `vehicle`: returns what the autopilot tells of depth and heading.
    """

    name = "dashboard"

    def __init__(
        self,
        server: DashboardServer,
        controls: Controls,
        vehicle: Callable[[], VehicleState | None],
    ) -> None:
        self._server, self._controls, self._vehicle = server, controls, vehicle
        self._state_s = self._picture_s = 0.0

    def send(self, sample: LiveSample) -> None:
        """Send a sample, and at intervals its picture behind the number of its frame."""
        # More than a pilot perceives; the remaining time of the machine is for the measurement.
        state_every_s, picture_every_s = 0.04, 0.08
        now_s = time.monotonic()
        if not self._server.hub.n_viewers or now_s - self._state_s < 0.5 * state_every_s:
            return
        self._state_s = now_s
        picture = None
        if sample.frame is not None and now_s - self._picture_s > picture_every_s:
            self._picture_s = now_s
            picture = sample.frame.index.to_bytes(4, "big") + page_picture(sample.frame)
        recording = self._controls.recorder.to_dict()
        setpoint = self._controls.setpoint.setpoint
        self._server.publish(page_state(sample, setpoint, recording, self._vehicle()), picture)

    def health(self) -> PartHealth:
        """Return how many pages are open."""
        n = self._server.hub.n_viewers
        return PartHealth(self.name, State.OK, f"{n} page{'' if n == 1 else 's'} open")

    def close(self) -> None:
        """End the server."""
        self._server.close()
