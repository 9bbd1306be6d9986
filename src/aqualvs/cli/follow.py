"""Signatures of `aqualvs follow` and `aqualvs tune`; bodies are imported when they run."""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from aqualvs.cli.command import (
    MavlinkKey,
    MavlinkPeer,
    Overwrite,
    VehicleFileOption,
    refuse_given,
    typed,
)

OF_A_VEHICLE = (
    "source", "rig", "mavlink", "vehicle_file", "mavlink_peer", "mavlink_key", "record",
    "record_to", "record_video", "target", "water_n",
)  # fmt: skip
"""Parameters of `aqualvs follow` that have no effect in a simulation."""
OF_A_SIMULATION = (
    "vehicle", "seconds", "current", "current_to", "waves", "cage_radius", "net_sway", "pilot_gain",
    "rendered", "camera", "shutter", "fps", "seed", "freeze",
)  # fmt: skip
"""Parameters of `aqualvs follow` that have no effect with a vehicle."""


def tune(
    model: Annotated[str, Argument(help="Vehicle model: bluerov2_heavy, bluerov2 or videoray.")],
    output: Annotated[
        Path | None,
        Option("-o", "--output", help="Gains file to write; by default the gains are printed."),
    ] = None,
    overwrite: Overwrite = False,
    delay_ms: Annotated[
        float,
        Option(help="Usual delay from exposure to vehicle; a shorter delay allows higher gains."),
    ] = 120.0,
    greatest_delay_ms: Annotated[
        float, Option(help="Maximum delay at which the loop must still be stable.")
    ] = 200.0,
    rate_hz: Annotated[float, Option(help="Frames per second.")] = 25.0,
    current: Annotated[float, Option(help="Maximum current in m/s.")] = 0.5,
) -> None:
    """Compute gains for a vehicle."""
    from aqualvs.control.tune import TuneOptions
    from aqualvs.errors import OptionError
    from aqualvs.follow import tune as body

    if not 1.0 <= rate_hz <= 1000.0:
        raise OptionError(f"--rate-hz {rate_hz:g}: give 1 to 1000 frames a second")
    options = TuneOptions(
        delay=1e-3 * delay_ms,
        greatest_delay=1e-3 * greatest_delay_ms,
        frame=1.0 / rate_hz,
        current=current,
    )
    body.run_tune(model, typer.echo, options, output=output, overwrite=overwrite)


def follow(
    context: typer.Context,
    source: Annotated[str | None, Argument(help="Stream or camera of a real vehicle.")] = None,
    sim: Annotated[bool, Option("--sim", help="Simulate vehicle, sea and net.")] = False,
    out: Annotated[Path, Option("--out", "-o", help="Folder to write.")] = Path("follow"),
    plan: Annotated[Path | None, Option(help="Plan file (YAML; docs/missions.md).")] = None,
    hold_range: Annotated[
        float | None, Option("--range", help="Range to hold in metres; 0.6 by default.")
    ] = None,
    yaw: Annotated[float, Option(help="Yaw to hold, in degrees; 0 is square.")] = 0.0,
    gains: Annotated[
        str | None,
        Option(
            metavar="FILE|NAME",
            help="Gains: a file from 'aqualvs tune', or bluerov2, bluerov2_heavy, videoray; "
            "with --sim tuned for the vehicle by default.",
        ),
    ] = None,
    rig: Annotated[Path | None, Option(help="Vehicle: rig file (YAML).")] = None,
    mavlink: Annotated[
        str | None, Option(help="Vehicle: ArduSub, such as udpin:0.0.0.0:14550.")
    ] = None,
    vehicle_file: VehicleFileOption = None,
    mavlink_peer: MavlinkPeer = None,
    mavlink_key: MavlinkKey = None,
    dashboard: Annotated[
        bool, Option("--dashboard", help="Serve the pilot's page; --sim then runs in real time.")
    ] = False,
    dashboard_address: Annotated[
        str, Option(metavar="HOST:PORT", help="Address of the pilot's page.")
    ] = "127.0.0.1:8100",
    token: Annotated[
        str | None, Option(envvar="AQUALVS_TOKEN", help="Password of the page.")
    ] = None,
    record: Annotated[bool, Option("--record", help="Vehicle: record from the start.")] = False,
    record_to: Annotated[
        Path | None, Option(help="Vehicle: folder of recordings; by default that of -o.")
    ] = None,
    record_video: Annotated[
        bool, Option("--record-video", help="Vehicle: also record the pictures.")
    ] = False,
    target: Annotated[
        str,
        Option(
            metavar="auto|net|solid|FILE", help="Vehicle: kind of target: a word, or a net.yaml."
        ),
    ] = "auto",
    water_n: Annotated[float | None, Option(help="Vehicle: refractive index of the water.")] = None,
    vehicle: Annotated[
        Literal["bluerov2", "bluerov2_heavy", "bluerov2-heavy", "videoray"],
        Option(metavar="bluerov2|bluerov2_heavy|videoray", help="Sim: vehicle model."),
    ] = "bluerov2",
    seconds: Annotated[float, Option(help="Sim: duration in seconds.")] = 60.0,
    current: Annotated[float, Option(help="Sim: current in m/s.")] = 0.3,
    current_to: Annotated[
        float,
        Option(help="Sim: direction of the current, in degrees to the right; 0: onto the net."),
    ] = 60.0,
    waves: Annotated[float, Option(help="Sim: amplitude of the waves in metres.")] = 0.1,
    cage_radius: Annotated[
        float, Option(help="Sim: radius of a round net seen from inside, in metres; 0: flat.")
    ] = 0.0,
    net_sway: Annotated[float, Option(help="Sim: amplitude of the net's motion in metres.")] = 0.0,
    pilot_gain: Annotated[float, Option(help="Sim: ArduSub's pilot gain.")] = 0.5,
    rendered: Annotated[
        bool, Option("--rendered", help="Sim: render every frame and measure it.")
    ] = False,
    camera: Annotated[
        str | None,
        Option(help="Sim, rendered: camera that takes the frames; ideal, webcam, action or pal."),
    ] = None,
    shutter: Annotated[
        str | None,
        Option(
            metavar="KIND[:MS]",
            help="Sim, rendered: rolling:READOUT:EXPOSURE, interlaced:EXPOSURE, global:EXPOSURE.",
        ),
    ] = None,
    fps: Annotated[float, Option(help="Sim: frames per second.")] = 25.0,
    seed: Annotated[int, Option(min=0, help="Sim: random seed of waves and noise.")] = 0,
    freeze: Annotated[
        float | None, Option(help="Sim: freeze the picture from this time on, in seconds.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Hold a distance to a net, or follow it."""
    from aqualvs.errors import OptionError
    from aqualvs.follow import command as body
    from aqualvs.live.options import Page

    dashboard = dashboard or bool(typed(context, "dashboard_address"))
    if not dashboard:
        refuse_given(context, ("token",), "for the pilot's page; add --dashboard")
    page = Page.of(dashboard_address, token) if dashboard else None
    aim = body.Aim(plan=plan, range=hold_range, yaw=math.radians(yaw))
    if sim:
        refuse_given(context, OF_A_VEHICLE, "for a vehicle; leave it out with --sim")
        request = body.SimRequest(
            out=out,
            aim=aim,
            vehicle=vehicle,
            gains=gains,
            pilot_gain=pilot_gain,
            current=current,
            current_to=math.radians(current_to),
            waves=waves,
            cage_radius=cage_radius,
            net_sway=net_sway,
            seconds=seconds,
            fps=fps,
            rendered=rendered,
            camera=camera,
            shutter=shutter,
            seed=seed,
            freeze=freeze,
            page=page,
            overwrite=overwrite,
        )
        raise typer.Exit(body.run_simulation(request, typer.echo))
    if source is None or rig is None or mavlink is None or gains is None:
        raise OptionError(
            "follow: give SOURCE, --rig, --mavlink and --gains for a vehicle, or --sim to try it"
        )
    refuse_given(context, OF_A_SIMULATION, "for a simulation; leave it out, or give --sim")
    from aqualvs.follow.vehicle import FollowRequest, run_follow
    from aqualvs.live.command import LiveRequest
    from aqualvs.live.options import vehicle_setup
    from aqualvs.results.run_request import Water, scanner_options
    from aqualvs.sources import open_feed

    live = LiveRequest(
        feed=partial(open_feed, source),
        rig=rig,
        page=page,
        # The page has a button for recording; without the page, nothing else starts one.
        record=record or (not dashboard and (record_video or record_to is not None)),
        record_to=out if record_to is None else record_to,
        record_video=record_video,
        water=Water(n_water=water_n, temperature_c=None, salinity=None),
        scanner=scanner_options(target, "ridge", "none", "robust"),
    )
    dive = FollowRequest(
        live=live,
        mavlink=mavlink,
        vehicle=vehicle_setup(vehicle_file, mavlink_peer, mavlink_key),
        gains=gains,
        out=out,
        aim=aim,
        overwrite=overwrite,
    )
    raise typer.Exit(run_follow(dive, typer.echo))
