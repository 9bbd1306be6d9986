"""Signatures and help of `aqualvs calibrate`, `board`, `import`, `export` and `schema`.

Bodies are imported when they run.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from aqualvs.cli.command import (
    Celsius,
    CheckedCommand,
    CommandGroups,
    Overwrite,
    Salinity,
    refuse_given,
)

_OF_BOARDS = ("squares_x", "squares_y", "square_mm", "border_mm")
_OF_A_BOX = ("width_mm", "height_mm", "depth_mm")
_OF_A_PLATE = ("position_mm", "rotation_deg")
# By kind of target: options that do not apply to it.
_NOT_OF = {
    "charuco": (*_OF_A_BOX, *_OF_A_PLATE, "first_id"),
    "chessboard": (*_OF_A_BOX, *_OF_A_PLATE, "first_id", "marker_mm", "dictionary"),
    "box": (*_OF_BOARDS, *_OF_A_PLATE),
    "plate": (*_OF_A_BOX, "square_mm"),
}

calibrate = typer.Typer(
    name="calibrate",
    help="Make a rig file from pictures: camera, dome, lasers, water, in this order; shutter last.",
    cls=CommandGroups,
    rich_markup_mode=None,
)


@calibrate.callback(invoke_without_command=True)
def _steps(context: typer.Context) -> None:
    """Print the help if no step is given."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(2)


Pictures = Annotated[
    list[str], Argument(help="Pictures, folders of them, or patterns such as 'air/*.png'.")
]
BoardFile = Annotated[Path, Option("--board", help="Board in the pictures (board.yaml).")]
RigIn = Annotated[Path, Option("--rig", help="Rig file of the previous step.")]
RigOut = Annotated[
    Path,
    Option("--out", "-o", help="Rig file to write; an existing one is kept under a dated name."),
]


def _sigma(what: str) -> Any:
    """Return the option of an uncertainty."""
    return Option(help=f"Uncertainty of {what} (one sigma).")


Medium = Annotated[
    str | None,
    Option(
        metavar="air|water|N",
        help="Medium outside the dome: air, the rig's water, or an index.",
        show_default=False,
    ),
]


@calibrate.command(
    cls=CheckedCommand,
    help="Intrinsics of the camera, from a board in air, without the dome.",
    epilog="Example: aqualvs calibrate camera air/*.png --board board.yaml -o rig.yaml",
)
def camera(
    images: Pictures,
    board: BoardFile,
    out: RigOut,
    nominal: Annotated[
        Path | None,
        Option(
            help="Nominal values: a rig file, or a file with name, dome, shutter, lasers, working "
            "range."
        ),
    ] = None,
    model: Annotated[Literal["opencv", "fisheye"], Option(help="Distortion model.")] = "opencv",
    coefficients: Annotated[
        Literal["auto", "0", "4", "5", "8"],
        Option(help="Number of distortion coefficients; auto takes as many as the data support."),
    ] = "auto",
) -> None:
    """Calibrate the camera."""
    from aqualvs.calibrate import camera as body

    body.run_camera(
        body.CameraRequest(
            images=tuple(images),
            board=board,
            out=out,
            nominal=nominal,
            model=model,
            n_coefficients=None if coefficients == "auto" else int(coefficients),
        ),
        typer.echo,
    )


@calibrate.command(
    cls=CheckedCommand,
    help="Position of the lens in the dome, from a board outside it, in air, in water, or both. "
    "With poses (distance only, or full) the camera's rotation is found too. For a flat port: its "
    "distance and tilt, from a board in water, without poses.",
    epilog="Example: aqualvs calibrate dome rail/*.png --board board.yaml --poses poses.csv "
    "--rig rig.yaml -o rig.yaml",
)
def dome(
    images: Pictures,
    board: BoardFile,
    rig: RigIn,
    out: RigOut,
    poses: Annotated[
        Path | None, Option(help="Known poses of the boards (poses.csv): distances, or full poses.")
    ] = None,
    medium: Medium = "air",
    water_images: Annotated[
        list[str] | None, Option(help="Additional pictures, taken in water; repeatable.")
    ] = None,
    water_board: Annotated[
        Path | None, Option(help="Board in --water-images, if it is a different one.")
    ] = None,
    water_poses: Annotated[
        Path | None, Option(help="Poses of the boards in --water-images.")
    ] = None,
    inner_radius_mm: Annotated[float | None, Option(help="Inner radius of the dome.")] = None,
    thickness_mm: Annotated[float | None, Option(help="Thickness of the housing.")] = None,
    n_acrylic: Annotated[float | None, Option(help="Refractive index of the housing.")] = None,
    port_distance_mm: Annotated[
        float | None,
        Option(help="Initial guess of a flat port's distance from the lens, instead of a dome."),
    ] = None,
    radius_tolerance_mm: Annotated[float, _sigma("the radius")] = 0.1,
    thickness_tolerance_mm: Annotated[float, _sigma("the thickness")] = 0.1,
    acrylic_tolerance: Annotated[float, _sigma("the housing's index")] = 0.003,
    distance_sigma_mm: Annotated[float, _sigma("the poses' distances")] = 0.2,
    shared_tilt_sigma_deg: Annotated[
        float,
        Option(
            help="Uncertainty (one sigma, about each axis) of a tilt that all boards at known "
            "distances share, as on a carriage that is not square to its rail."
        ),
    ] = 0.0,
    refine_intrinsics: Annotated[
        bool,
        Option(
            "--refine-intrinsics/--keep-intrinsics",
            help="Refine the intrinsics within the uncertainty of the camera's calibration.",
        ),
    ] = True,
) -> None:
    """Calibrate the dome."""
    from aqualvs.calibrate import dome as body

    body.run_dome(
        body.DomeRequest(
            images=tuple(images),
            board=board,
            rig=rig,
            out=out,
            poses=poses,
            medium=medium or "air",
            water_images=tuple(water_images or ()),
            water_board=water_board,
            water_poses=water_poses,
            inner_radius_mm=inner_radius_mm,
            thickness_mm=thickness_mm,
            n_acrylic=n_acrylic,
            port_distance_mm=port_distance_mm,
            radius_tolerance_mm=radius_tolerance_mm,
            thickness_tolerance_mm=thickness_tolerance_mm,
            acrylic_tolerance=acrylic_tolerance,
            distance_sigma_mm=distance_sigma_mm,
            shared_tilt_sigma_deg=shared_tilt_sigma_deg,
            refine_intrinsics=refine_intrinsics,
        ),
        typer.echo,
    )


@calibrate.command(
    cls=CheckedCommand,
    help="Laser planes, all lasers on at once, from a box of markers (--box), or from stripes on "
    "a plane that carries a board (--board).",
    epilog="Example: aqualvs calibrate lasers box/*.png --box box.yaml --rig rig.yaml -o rig.yaml",
)
def lasers(
    images: Pictures,
    rig: RigIn,
    out: RigOut,
    box: Annotated[Path | None, Option(help="Box of markers (box.yaml).")] = None,
    board: Annotated[Path | None, Option(help="Board on the plane of the stripes.")] = None,
    medium: Medium = None,
    n_lasers: Annotated[int | None, Option("--lasers", help="Number of lasers, if known.")] = None,
    names: Annotated[
        str | None,
        Option(metavar="A,B,C", help="Names of the lasers, left to right in the picture."),
    ] = None,
    wavelength_nm: Annotated[
        float | None,
        Option(
            help="Wavelength of the lasers, for example 650 for red; by default that of the rig's "
            "lasers, else green."
        ),
    ] = None,
    board_offset_mm: Annotated[
        float, Option(help="Distance of the board in front of the plane of the stripes.")
    ] = 0.0,
    refine: Annotated[
        bool, Option("--refine", help="Refine camera, dome and water together with the planes.")
    ] = False,
) -> None:
    """Calibrate the lasers."""
    from aqualvs.calibrate import lasers as body

    body.run_lasers(
        body.LasersRequest(
            images=tuple(images),
            rig=rig,
            out=out,
            box=box,
            board=board,
            medium=medium,
            n_lasers=n_lasers,
            names=None if names is None else tuple(name.strip() for name in names.split(",")),
            board_offset_mm=board_offset_mm,
            refine=refine,
            wavelength_nm=wavelength_nm,
        ),
        typer.echo,
    )


@calibrate.command(
    cls=CheckedCommand,
    help="Refractive index of the water, from a target fixed to the vehicle. SOURCE is a video, "
    "pictures, or a folder of them.",
    epilog="Example: aqualvs calibrate water dive.mp4 --target target.yaml --rig rig.yaml "
    "-o rig.yaml",
)
def water(
    source: Annotated[list[str], Argument(help="Video, pictures, or a folder of them.")],
    target: Annotated[Path, Option(help="Target on the vehicle (target.yaml).")],
    rig: RigIn,
    out: RigOut,
    temperature_c: Celsius = None,
    salinity: Salinity = None,
    fps: Annotated[float | None, Option(help="Frame rate of pictures.")] = None,
    place_sigma_mm: Annotated[float, _sigma("the target's position")] = 0.2,
    turn_sigma_deg: Annotated[float, _sigma("the target's rotation")] = 0.1,
) -> None:
    """Calibrate the water."""
    from aqualvs.calibrate import water as body

    body.run_water(
        body.WaterRequest(
            source=tuple(source),
            target=target,
            rig=rig,
            out=out,
            temperature_c=temperature_c,
            salinity=salinity,
            fps=fps,
            place_sigma_mm=place_sigma_mm,
            turn_sigma_deg=turn_sigma_deg,
        ),
        typer.echo,
    )


@calibrate.command(
    cls=CheckedCommand,
    help="Readout time of a rolling shutter, from a 20 s dive in which the vehicle swings in front "
    "of a wall.",
    epilog="Example: aqualvs calibrate shutter dive.mp4 --rig rig.yaml -o rig.yaml",
)
def shutter(
    source: Annotated[str, Argument(help="Video, or a folder of pictures.")],
    rig: RigIn,
    out: RigOut,
    fps: Annotated[float | None, Option(help="Frame rate of pictures.")] = None,
) -> None:
    """Calibrate the shutter."""
    from aqualvs.calibrate import shutter as body

    body.run_shutter(body.ShutterRequest(source=source, rig=rig, out=out, fps=fps), typer.echo)


def board(
    context: typer.Context,
    kind: Annotated[
        Literal["charuco", "chessboard", "box", "plate"],
        Argument(
            help="A board for camera and dome, the markers of a box for the lasers, or a plate "
            "of markers, fixed to the vehicle, for the water."
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="OUT.pdf and OUT.yaml are written.")],
    paper: Annotated[
        str, Option(metavar="a4..a0|letter|WxH|fit", help="Paper; WxH in millimetres.")
    ] = "a4",
    squares_x: Annotated[
        int | None, Option(help="Number of squares, or markers of a plate, across.")
    ] = None,
    squares_y: Annotated[
        int | None, Option(help="Number of squares, or markers of a plate, down.")
    ] = None,
    square_mm: Annotated[
        float | None, Option(help="Side of a square; by default as large as fits.")
    ] = None,
    marker_mm: Annotated[float | None, Option(help="Side of a marker.")] = None,
    dictionary: Annotated[
        str | None, Option(help="OpenCV's name of the marker dictionary.")
    ] = None,
    border_mm: Annotated[float | None, Option(help="Light border of a board.")] = None,
    width_mm: Annotated[float, Option(help="Width of the box, inside.")] = 400.0,
    height_mm: Annotated[float, Option(help="Height of the box, inside.")] = 380.0,
    depth_mm: Annotated[float, Option(help="Depth of the box, inside.")] = 700.0,
    first_id: Annotated[int, Option(min=0, help="Number of the first marker.")] = 0,
    position_mm: Annotated[
        tuple[float, float, float] | None,
        Option(metavar="X Y Z", help="Position of the plate's first corner in the dome's frame."),
    ] = None,
    rotation_deg: Annotated[
        tuple[float, float, float],
        Option(metavar="X Y Z", help="Rotation vector of the plate in the dome's frame."),
    ] = (0.0, 0.0, 0.0),
    overwrite: Overwrite = False,
) -> None:
    """Print a target."""
    refuse_given(context, _NOT_OF[kind], f"not of a {kind}; leave it out")
    from aqualvs.calibrate import board as body

    body.print_board(
        body.BoardRequest(
            kind=kind,
            out=out,
            paper=paper,
            squares_x=squares_x,
            squares_y=squares_y,
            square_mm=square_mm,
            marker_mm=marker_mm,
            dictionary=dictionary,
            border_mm=border_mm,
            width_mm=width_mm,
            height_mm=height_mm,
            depth_mm=depth_mm,
            first_id=first_id,
            position_mm=position_mm,
            rotation_deg=rotation_deg,
            overwrite=overwrite,
        ),
        typer.echo,
    )


def import_file(
    file: Annotated[
        Path,
        Argument(
            help="camera_info.yaml of ROS, FileStorage of OpenCV (YAML, XML, JSON), camchain or "
            "target of Kalibr, .cameramodel of mrcal, cameras.txt of COLMAP or Refractive COLMAP."
        ),
    ],
    out: Annotated[
        Path,
        Option(
            "--out",
            "-o",
            help="Rig file to write, or board.yaml; an existing rig file is kept under a dated "
            "name.",
        ),
    ],
    what: Annotated[
        Literal["camera", "rig", "board"] | None,
        Option(
            "--as",
            help="camera: the intrinsics only; rig: also the dome, if the file has one; board: a "
            "Kalibr target. By default everything in the file.",
        ),
    ] = None,
    camera: Annotated[
        str | None, Option(metavar="NAME", help="Which camera, if there are several.")
    ] = None,
    model: Annotated[
        Literal["opencv", "fisheye"] | None,
        Option(help="Distortion model, if an OpenCV FileStorage does not state it."),
    ] = None,
    image: Annotated[
        str | None, Option(metavar="WxH", help="Size of the pictures, if the file lacks it.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Import a calibration."""
    from aqualvs.calibration_files import command as body

    body.run_import(
        body.ImportRequest(
            source=file,
            out=out,
            what=what,
            camera=camera,
            model=model,
            image=image,
            overwrite=overwrite,
        ),
        typer.echo,
    )


def export(
    rig: Annotated[Path, Argument(help="Rig file.")],
    to: Annotated[
        Literal["ros", "opencv", "kalibr", "mrcal", "colmap", "colmap-underwater"],
        Option(help="Format; colmap-underwater is Refractive COLMAP, with the dome."),
    ],
    out: Annotated[
        Path,
        Option(
            "--out", "-o", help="File to write; .xml and .json choose the form of a FileStorage."
        ),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Export a rig's camera."""
    from aqualvs.calibration_files import command as body

    body.run_export(body.ExportRequest(rig=rig, to=to, out=out, overwrite=overwrite), typer.echo)


def schema() -> None:
    """Print the JSON Schema of rig files."""
    import json

    from aqualvs.optics.rigschema import rig_json_schema

    typer.echo(json.dumps(rig_json_schema(), indent=1))
