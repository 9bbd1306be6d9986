"""Signatures and help of `aqualvs import`, `aqualvs export` and `aqualvs schema`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from aqualvs.cli.command import Overwrite


def import_file(
    file: Annotated[
        Path,
        typer.Argument(
            help="camera_info.yaml of ROS, FileStorage of OpenCV (YAML, XML, JSON), camchain or "
            "target of Kalibr, .cameramodel of mrcal, cameras.txt of COLMAP or Refractive COLMAP."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Rig file to write, or board.yaml; a rig that is there is kept under a dated "
            "name.",
            show_default=False,
        ),
    ],
    what: Annotated[
        Literal["camera", "rig", "board"] | None,
        typer.Option(
            "--as",
            help="camera: the intrinsics alone; rig: the dome too, if the file has one; board: a "
            "target of Kalibr. Without it, all that the file holds.",
            show_default=False,
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Which camera, if there are several.", show_default=False
        ),
    ] = None,
    model: Annotated[
        Literal["opencv", "fisheye"] | None,
        typer.Option(
            help="Distortion model, where a FileStorage of OpenCV does not say it.",
            show_default=False,
        ),
    ] = None,
    image: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Size of the pictures, if the file lacks it.", show_default=False
        ),
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
    rig: Annotated[Path, typer.Argument(help="Rig file.")],
    to: Annotated[
        Literal["ros", "opencv", "kalibr", "mrcal", "colmap", "colmap-underwater"],
        typer.Option(help="Format; colmap-underwater is Refractive COLMAP, with the dome."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="File to write; .xml and .json choose the form of a FileStorage.",
            show_default=False,
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
