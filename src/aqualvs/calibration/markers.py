"""Markers as OpenCV reads them: numbers and rough corners."""

from dataclasses import dataclass

import cv2
import numpy as np

from aqualvs.calibration.saddle_corners import GreyImage
from aqualvs.calibration.targets import aruco_dictionary
from aqualvs.geometry.arrays import FloatArray, IntArray

# Widest window of the local threshold, as a share of the picture's width.
_WIDEST_WINDOW = 0.03


@dataclass(frozen=True, slots=True)
class Markers:
    """Markers as OpenCV reads them, not refined.

    Attributes
    ----------
    ids : int array, shape (M,)
        Numbers in the dictionary.
    corners : array, shape (M, 4, 2)
        In `image`, in OpenCV's order.
    """

    ids: IntArray
    corners: FloatArray

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.ids)


def read_markers(
    image: GreyImage, dictionary: str, *, n_first: int | None = None, window_px: int | None = None
) -> Markers:
    """Read markers in a picture, by contour, to about half a pixel.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    dictionary : str
        Name of the markers' dictionary.
    n_first : int or None
        Read only the first so many markers of the dictionary, which is faster.
    window_px : int or None
        Odd width of the only local threshold; None tries several.
    """
    parameters = cv2.aruco.DetectorParameters()
    if window_px is not None:
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    else:
        widest = _WIDEST_WINDOW * image.shape[1]
        parameters.adaptiveThreshWinSizeMax = max(parameters.adaptiveThreshWinSizeMax, int(widest))
    markers = aruco_dictionary(dictionary)
    if n_first is not None:
        markers = cv2.aruco.Dictionary(
            markers.bytesList[:n_first], markers.markerSize, markers.maxCorrectionBits
        )
    corners, ids, _ = cv2.aruco.ArucoDetector(markers, parameters).detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    return Markers(
        np.asarray(ids, np.int64).ravel(), np.asarray(corners, np.float64).reshape(-1, 4, 2)
    )
