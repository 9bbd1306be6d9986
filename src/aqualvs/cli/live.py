"""Signatures of `aqualvs live` and `aqualvs doctor`; bodies are imported when they run."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from aqualvs.cli.command import (
    Celsius,
    IndexTarget,
    MavlinkKey,
    MavlinkPeer,
    Salinity,
    Target,
    VehicleFileOption,
    WaterIndex,
    refuse_given,
    typed,
)

_OF_MAVLINK = ("vehicle_file", "mavlink_peer", "mavlink_key")


def live(
    context: typer.Context,
    source: Annotated[str, Argument(help="Stream, camera or file; docs/sources.md has a table.")],
    rig: Annotated[Path, Option("--rig", help="Rig file (YAML).")],
    mavlink: Annotated[
        list[str] | None,
        Option(help="Send to an autopilot, such as udpout:192.168.2.1:14550; repeatable."),
    ] = None,
    vehicle_file: VehicleFileOption = None,
    mavlink_peer: MavlinkPeer = None,
    mavlink_key: MavlinkKey = None,
    json: Annotated[
        list[str] | None, Option(help="Send lines of JSON by UDP to HOST:PORT; repeatable.")
    ] = None,
    ros2: Annotated[bool, Option("--ros2", help="Publish to ROS 2.")] = False,
    ros1: Annotated[bool, Option("--ros1", help="Publish to ROS 1 (Noetic).")] = False,
    foxglove: Annotated[
        bool, Option("--foxglove", help="Serve Foxglove at ws://127.0.0.1:8765.")
    ] = False,
    foxglove_address: Annotated[
        str, Option(metavar="HOST:PORT", help="Address of the Foxglove server.")
    ] = "127.0.0.1:8765",
    rerun: Annotated[
        str | None,
        Option(
            metavar="viewer|HOST:PORT|FILE.rrd",
            help="Show in Rerun: open a viewer, connect to an open one, or write a file.",
        ),
    ] = None,
    dashboard: Annotated[
        bool, Option("--dashboard", help="Serve the pilot's page at http://127.0.0.1:8100.")
    ] = False,
    dashboard_address: Annotated[
        str,
        Option(
            metavar="HOST:PORT",
            help="Address of the pilot's page; any other than 127.0.0.1 needs a token.",
        ),
    ] = "127.0.0.1:8100",
    token: Annotated[
        str | None,
        Option(
            envvar="AQUALVS_TOKEN",
            help="Password of the page; generated and printed if one is needed.",
        ),
    ] = None,
    embed_from: Annotated[
        list[str] | None,
        Option(
            envvar="AQUALVS_EMBED_FROM",
            metavar="ORIGIN",
            help="Let pages of this origin embed the page, such as http://blueos.local; "
            "repeatable.",
        ),
    ] = None,
    record: Annotated[bool, Option("--record", help="Record from the start.")] = False,
    record_to: Annotated[Path, Option(help="Folder of recordings.")] = Path("dives"),
    record_video: Annotated[
        bool, Option("--record-video", help="Also record the pictures.")
    ] = False,
    smooth: Annotated[
        bool, Option("--filter", help="Add time-filtered values; raw values stay available.")
    ] = False,
    fast: Annotated[
        bool, Option("--fast", help="For files: measure every frame, as fast as possible.")
    ] = False,
    fps: Annotated[
        float | None,
        Option(help="Frame rate of images (1 by default), or to request from a camera."),
    ] = None,
    size: Annotated[
        str | None, Option(metavar="WxH", help="Picture size to request from a camera.")
    ] = None,
    pixel_format: Annotated[
        str | None, Option(help="Format to request from a camera: h264, mjpeg, yuyv422.")
    ] = None,
    transport: Annotated[
        Literal["tcp", "udp"] | None, Option(help="Transport of RTSP; tcp by default.")
    ] = None,
    target: Target = "auto",
    detector: Annotated[Literal["ridge", "threshold"], Option(help="Stripe detector.")] = "ridge",
    water_n: WaterIndex = None,
    temperature_c: Celsius = None,
    salinity: Salinity = None,
    index_target: IndexTarget = None,
) -> None:
    """Measure live."""
    foxglove = foxglove or bool(typed(context, "foxglove_address"))
    dashboard = dashboard or bool(typed(context, "dashboard_address"))
    # The page has a button for recording; without the page, nothing else starts one.
    record = record or (not dashboard and bool(typed(context, "record_video", "record_to")))
    if not dashboard:
        refuse_given(context, ("token", "embed_from"), "for the pilot's page; add --dashboard")
    if not mavlink:
        refuse_given(context, _OF_MAVLINK, "for a MAVLink connection; add --mavlink")
    from aqualvs.live import command as body
    from aqualvs.live.options import Page, output_makers, vehicle_setup
    from aqualvs.results.run_request import Water, scanner_options
    from aqualvs.sources import open_feed

    scanner = scanner_options(target, detector, "none", "robust")
    outputs = output_makers(
        mavlink=mavlink or (),
        link=vehicle_setup(vehicle_file, mavlink_peer, mavlink_key).link,
        json=json or (),
        ros2=ros2,
        ros1=ros1,
        foxglove=foxglove_address if foxglove else None,
        rerun=rerun,
        scanner=scanner,
    )
    request = body.LiveRequest(
        feed=partial(
            open_feed,
            source,
            realtime=not fast,
            fps=fps,
            size_px=None if size is None else body.camera_size(size),
            pixel_format=pixel_format,
            transport=transport,
        ),
        rig=rig,
        outputs=tuple(outputs),
        page=Page.of(dashboard_address, token, embed_from or ()) if dashboard else None,
        record=record,
        record_to=record_to,
        record_video=record_video,
        smooth=smooth,
        fast=fast,
        water=Water(n_water=water_n, temperature_c=temperature_c, salinity=salinity),
        scanner=scanner,
        index_target=index_target,
    )
    raise typer.Exit(body.run_live(request, typer.echo))


def doctor(
    context: typer.Context,
    source: Annotated[str | None, Argument(help="Stream, camera or file to check.")] = None,
    rig: Annotated[Path | None, Option(help="Rig file that the pictures should match.")] = None,
    mavlink: Annotated[str | None, Option(help="Autopilot to listen for.")] = None,
    vehicle_file: VehicleFileOption = None,
    mavlink_peer: MavlinkPeer = None,
    mavlink_key: MavlinkKey = None,
) -> None:
    """Check the machine."""
    if mavlink is None:
        refuse_given(context, _OF_MAVLINK, "for a MAVLink connection; add --mavlink")
    from aqualvs.check.doctor import run_doctor
    from aqualvs.live.options import vehicle_setup

    run_doctor(source, rig, mavlink, vehicle_setup(vehicle_file, mavlink_peer, mavlink_key))
