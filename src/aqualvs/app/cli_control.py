"""The command line of controllers: signatures only; bodies are imported when they run."""

from pathlib import Path
from typing import Annotated

import typer

from aqualvs.app.cli_options import Overwrite


def tune(
    model: Annotated[
        str, typer.Argument(help="Vehicle model: bluerov2_heavy, bluerov2 or videoray.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Gains file; printed if left out.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    delay_ms: Annotated[
        float,
        typer.Option(help="Usual delay from the exposure to the vehicle. Less makes it faster."),
    ] = 120.0,
    greatest_delay_ms: Annotated[
        float, typer.Option(help="Delay at which it must still be stable.")
    ] = 200.0,
    rate_hz: Annotated[float, typer.Option(help="Frames a second.")] = 25.0,
    current: Annotated[float, typer.Option(help="Greatest current in m/s.")] = 0.5,
) -> None:
    """Make gains for a vehicle, and say what margins they leave."""
    from aqualvs.app import tune as body
    from aqualvs.control.tune import TuneOptions
    from aqualvs.errors import OptionError

    if not rate_hz > 0.0:
        raise OptionError(f"--rate-hz {rate_hz:g}: must be positive")
    options = TuneOptions(
        delay=1e-3 * delay_ms,
        greatest_delay=1e-3 * greatest_delay_ms,
        frame=1.0 / rate_hz,
        current=current,
    )
    body.tune_and_tell(
        body.TuneRequest(model=model, output=output, overwrite=overwrite, options=options),
        typer.echo,
    )
