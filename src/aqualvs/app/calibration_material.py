"""What the page of a calibration shows: plain values, filled in by the commands.

Units are those of the page, as the suffixes say. A number that is not known is NaN, or None where
the type allows it; the page shows a dash for it. Every part of a page may be empty.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from aqualvs.app.report_findings import Card
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.scan import ImagePlane

MarkKind: TypeAlias = Literal["cross", "dot", "circle"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualMap:
    """Reprojection residuals over the picture, for the points of all views together.

    Attributes
    ----------
    title : str
    size_px : (int, int)
        Width and height of the pictures.
    pixels : array, shape (N, 2)
        Measured points as (x, y); rows that are not finite are left out.
    residuals : array, shape (N, 2)
        Measured minus predicted, in pixels.
    view_index : int array, shape (N,)
        Row of the view in `Page.views`.
    inliers : bool array, shape (N,)
        False for points that the solution did not use.
    """

    title: str
    size_px: tuple[int, int]
    pixels: FloatArray
    residuals: FloatArray
    view_index: IntArray
    inliers: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRow:
    """One view: a picture in which the target was looked for.

    Attributes
    ----------
    name : str
    n_points : int
    rms_px : float
        Of the distances between measured and predicted points.
    remark : str
        Why it was left out, say; may be empty.
    used : bool
        Whether the solution rests on it.
    """

    name: str
    n_points: int
    rms_px: float
    remark: str = ""
    used: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterRow:
    """One calibrated parameter.

    Attributes
    ----------
    name : str
    value : float
    sigma : float or None
        Standard deviation; None for a parameter that was held.
    unit : str
    digits : int
        Decimals of the value.
    before : float or None
        What the rig said before the calibration.
    remark : str
    """

    name: str
    value: float
    sigma: float | None
    unit: str = ""
    digits: int = 2
    before: float | None = None
    remark: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectationRow:
    """What the calibration lets expect on a target, as standard deviations.

    Attributes
    ----------
    range_m : float
        Distance of the target.
    sigma_range_mm, sigma_pitch_deg, sigma_yaw_deg : float
        Systematic: from the calibration's covariance, the same in every picture.
    noise_range_mm, noise_pitch_deg, noise_yaw_deg : float
        Random: from the noise of the stripes in one picture.
    """

    range_m: float
    sigma_range_mm: float
    sigma_pitch_deg: float
    sigma_yaw_deg: float
    noise_range_mm: float = float("nan")
    noise_pitch_deg: float = float("nan")
    noise_yaw_deg: float = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserRow:
    """One calibrated laser plane, n·X = offset in `dome`.

    Attributes
    ----------
    name : str
    normal : array, shape (3,)
        Unit normal in `dome`.
    offset_mm : float
    sigma_normal_deg, sigma_offset_mm : float
        Standard deviations of the normal's direction and of the offset.
    rms_px, rms_mm : float
        Of the points' distances from the plane, in the picture and in space.
    n_points : int
    surfaces : str
        What its stripes were seen on: "floor, back wall".
    model : str
        "plane" or "refracted sheet".
    moved : str
        In words, against the rig before; may be empty.
    """

    name: str
    normal: FloatArray
    offset_mm: float
    sigma_normal_deg: float
    sigma_offset_mm: float
    rms_px: float
    rms_mm: float
    n_points: int
    surfaces: str = ""
    model: str = "plane"
    moved: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """A value over something, usually time.

    Attributes
    ----------
    title, x_label, y_label : str
    x, y : array, shape (N,)
        `x` ascending; the line is broken where `y` is NaN.
    sigma : array, shape (N,), or None
        Standard deviations of `y`, drawn as a band.
    level : (str, float) or None
        A named horizontal line.
    marks : tuple of (float, str)
        Places on the x axis and what happened there.
    """

    title: str
    x_label: str
    y_label: str
    x: FloatArray
    y: FloatArray
    sigma: FloatArray | None = None
    level: tuple[str, float] | None = None
    marks: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlay:
    """Points drawn over a picture.

    Attributes
    ----------
    pixels : array, shape (N, 2)
        (x, y) in the full picture; rows that are not finite are left out.
    colour : str
        #RRGGBB.
    kind : {'cross', 'dot', 'circle'}
    label : str
        What they are, for the legend; without one the legend leaves them out.
    """

    pixels: FloatArray
    colour: str
    kind: MarkKind = "cross"
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureShot:
    """A picture with points drawn over it.

    Attributes
    ----------
    caption : str
    image : uint8 array, shape (height, width) or (height, width, 3)
        Grey, or blue, green, red.
    points : tuple of Overlay
    """

    caption: str
    image: ImagePlane
    points: tuple[Overlay, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """The page of one calibration.

    Attributes
    ----------
    title, subtitle : str
    cards : tuple of Card
        The headline's numbers.
    warnings : tuple of str
    words : tuple of str
        What was found, one plain sentence each.
    residual_maps : tuple of ResidualMap
    views : tuple of ViewRow
    parameters : tuple of ParameterRow
    expectations : tuple of ExpectationRow
    lasers : tuple of LaserRow
        In the rig's order, which gives them their colours.
    series : tuple of Series
    pictures : tuple of PictureShot
    facts : tuple of (str, str)
        Date, command, versions, files.
    """

    title: str
    subtitle: str = ""
    cards: tuple[Card, ...] = ()
    warnings: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    residual_maps: tuple[ResidualMap, ...] = ()
    views: tuple[ViewRow, ...] = ()
    parameters: tuple[ParameterRow, ...] = ()
    expectations: tuple[ExpectationRow, ...] = ()
    lasers: tuple[LaserRow, ...] = ()
    series: tuple[Series, ...] = ()
    pictures: tuple[PictureShot, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
