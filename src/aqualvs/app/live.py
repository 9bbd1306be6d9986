"""`aqualvs live`: from a stream to pilot, autopilot and log."""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from aqualvs.app.live_console import Console
from aqualvs.app.live_outputs import OutputRequest, make_outputs
from aqualvs.app.live_water import WaterFollower
from aqualvs.app.pilot_page import serve_page
from aqualvs.app.run_inputs import Water, prepared_rig
from aqualvs.app.run_water import WaterFollowingScanner
from aqualvs.app.stopping import StopSignals
from aqualvs.control.setpoint import SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.live.recorder import PictureFormat, RecorderOptions, RecorderSwitch
from aqualvs.live.runner import FixedScanner, LiveOptions, LiveRunner, ScannerSupply
from aqualvs.live.sources.feed import Feed
from aqualvs.live.sources.opening import open_feed
from aqualvs.live.sources.remote import Transport
from aqualvs.live.time_filter import PostureFilter
from aqualvs.live.warm_up import warm_up
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import Scanner, ScannerOptions

# Threads wait for the interpreter at most so long; Python's own 5 ms would show in the delays.
SWITCH_S = 0.0005


@dataclass(frozen=True, slots=True, kw_only=True)
class FeedRequest:
    """How the source shall deliver, where it has a choice; see `open_feed`.

    Attributes
    ----------
    fps : float or None
        Of images, or asked of a camera.
    size : str or None
        `WIDTHxHEIGHT`, asked of a camera.
    pixel_format : str or None
        Asked of a camera.
    transport : {"tcp", "udp"} or None
        How RTSP shall send.
    """

    fps: float | None = None
    size: str | None = None
    pixel_format: str | None = None
    transport: Transport | None = None

    def opened(self, source: str, *, realtime: bool) -> Feed:
        """Return the feed of a source.

        Raises
        ------
        OptionError, SourceError
            As `open_feed`; also if the size is none.
        """
        return open_feed(
            source,
            realtime=realtime,
            fps=self.fps,
            size_px=None if self.size is None else _size_px(self.size),
            pixel_format=self.pixel_format,
            transport=self.transport,
        )


def _size_px(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise OptionError(f"--size {text}: not understood; give WIDTHxHEIGHT, such as 1920x1080")
    return int(width), int(height)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveRequest:
    """What to run live.

    Attributes
    ----------
    source : str
        As `open_feed` takes it.
    rig : Path
    feed : FeedRequest
    outputs : OutputRequest
    dashboard : str or None
        Address HOST:PORT of the pilot's page.
    token : str or None
        Its password.
    record : bool
        Whether to record from the start; the page's button begins and ends recordings, too.
    record_to : Path
        Folder of recordings.
    record_video : bool
    smooth : bool
        Whether the time filter runs.
    fast : bool
        Measure every frame of a file, as fast as possible.
    water : Water
    scanner : ScannerOptions
    index_target : Path or None
        Markers on the vehicle that tell the water's index.
    """

    source: str
    rig: Path
    feed: FeedRequest = field(default_factory=FeedRequest)
    outputs: OutputRequest = field(default_factory=OutputRequest)
    dashboard: str | None = None
    token: str | None = None
    record: bool = False
    record_to: Path = Path("dives")
    record_video: bool = False
    smooth: bool = False
    fast: bool = False
    water: Water = field(default_factory=Water)
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    index_target: Path | None = None


def live_and_tell(request: LiveRequest, tell: Callable[[str], object]) -> int:
    """Run until the source ends or somebody stops it, which is how live runs end; returns 0.

    Raises
    ------
    AqualvsError
        If an input cannot be used, or the source can never work.
    """
    rig = prepared_rig(request.rig, request.water, no_dome=False)
    feed = request.feed.opened(request.source, realtime=not request.fast)
    sys.setswitchinterval(SWITCH_S)
    with ExitStack() as undo:
        undo.callback(feed.close)
        outputs = _outputs(request, rig, tell)
        for output in outputs:
            undo.callback(output.close)
        runner = LiveRunner(
            feed,
            _supply(request, rig),
            outputs,
            LiveOptions(keep_every=request.fast),
            PostureFilter() if request.smooth else None,
        )
        undo.pop_all()
    with StopSignals() as stop:
        fault = runner.run(lambda: stop.caught is not None)
    if fault is not None:
        raise fault
    return 0


def _outputs(request: LiveRequest, rig: Rig, tell: Callable[[str], object]) -> list[Output]:
    """Make all outputs; those made before one that fails are closed."""
    options = recorder_options(request.scanner, video=request.record_video)
    recorder = RecorderSwitch(request.record_to, options)
    with ExitStack() as made:
        outputs: list[Output] = [recorder, Console()]
        made.callback(recorder.close)
        if request.record:
            tell(f"recording: {recorder.start()}")
        outputs += make_outputs(request.outputs)
        for output in outputs[2:]:
            made.callback(output.close)
        if request.dashboard is not None:
            holder = SetpointHolder(rig.working_range)
            outputs.append(
                serve_page(request.dashboard, request.token, rig, holder, recorder, tell)
            )
        made.pop_all()
    return outputs


def recorder_options(scanner: ScannerOptions, *, video: bool) -> RecorderOptions:
    """Return what recordings hold: with `video` the pictures, too."""
    return RecorderOptions(pictures=PictureFormat.JPEG if video else None, scanner=scanner)


def _supply(request: LiveRequest, rig: Rig) -> ScannerSupply:
    if request.index_target is None:
        scanner = Scanner(rig, request.scanner)
        warm_up(scanner)
        return FixedScanner(scanner)
    if rig.dome is None:
        raise OptionError("--index-target: without a dome the water's index cannot be seen")
    following = WaterFollowingScanner(rig, request.scanner, request.index_target, request.water)
    warm_up(following.scanner)
    return WaterFollower(following)
