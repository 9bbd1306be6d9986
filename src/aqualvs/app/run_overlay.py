"""The video that shows what the scanner saw."""

from pathlib import Path

import numpy as np

from aqualvs.app.disk import writing
from aqualvs.app.outputs import OVERLAY_MP4
from aqualvs.app.overlay import OverlayWriter, draw_overlay
from aqualvs.closing import Closing
from aqualvs.live.colour import bgr_of
from aqualvs.live.sources import FrameSource
from aqualvs.optics.rig import Rig
from aqualvs.scanning.scan import Frame, Scan

_FPS_WITHOUT_CLOCK = 25.0


class RunOverlay(Closing):
    """Writes `overlay.mp4` while a run goes on, or does nothing; a context manager.

    Parameters
    ----------
    folder : Path
    rig : Rig
    source : FrameSource
        Gives size and rate of the video.
    wanted : bool
        False makes `write` do nothing.

    Raises
    ------
    OutputError
        From every method, if the video cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig, source: FrameSource, *, wanted: bool) -> None:
        self._path = folder / OVERLAY_MP4
        self._rig = rig
        self._writer: OverlayWriter | None = None
        if wanted:
            fps = source.fps or _FPS_WITHOUT_CLOCK
            self._writer = OverlayWriter(self._path, source.size_px, fps)

    def write(self, frame: Frame | None, scan: Scan) -> None:
        """Append a picture; a lost frame gives a black one, so that frames keep their number."""
        if self._writer is None:
            return
        width, height = self._rig.size_px
        image = np.zeros((height, width, 3), np.uint8) if frame is None else bgr_of(frame)
        with writing(self._path):
            self._writer.write(draw_overlay(image, scan.points, scan.posture, self._rig))

    def close(self) -> None:
        """Finish the video."""
        if self._writer is not None:
            with writing(self._path):
                self._writer.close()
