"""Line lasers as light sources: irradiance of their sheets, and their colour for a camera.

The camera's record of a green laser is one number for each colour filter, fitted to real pictures
of laser lines; three Gaussians carry it over to other wavelengths. Real filters are lopsided and
differ between makers: Jiang, Liu, Gu and Süsstrunk, "What is the space of spectral sensitivity
functions for digital color cameras?" (WACV 2013), measured 28 cameras, with peaks near 600, 530
and 460 nm. The water attenuates a laser by the bands red, green and blue, interpolated linearly at
its wavelength (`band_shares`).

Compiled kernels work on the sheets as tables (`Sheets`): thickness, opening of the fan, distance at
which a surface ends the light.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, along, dot, minus, row3
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.sheet import (
    START,
    WINDOWED,
    Sheet,
    crossing,
    packed_sheets,
    sheet_in,
    sheets_of,
)
from aqualvs.optics.water import GREEN_NM
from aqualvs.simulation.scene import Vector

# Middles of the bands red, green and blue, in which scenes and water are described.
_BANDS_NM = np.array([620.0, GREEN_NM, 460.0])

LUMA: FloatArray = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in luma (ITU-R BT.601)."""
LUMA.flags.writeable = False


def band_shares(wavelength_nm: float) -> FloatArray:
    """Return the weights (3,) of the water's red, green and blue bands at a wavelength.

    Linear between the middles of the bands, constant beyond: a laser of 635 nm is dimmed as red.
    """
    upward = np.interp(wavelength_nm, _BANDS_NM[::-1], np.arange(3.0))
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(np.array([2.0, 1.0, 0.0]) - upward)))


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourFilters:
    """Colour filters of a sensor, and the colour matrix that corrects their crosstalk."""

    # Response of the pixels under the red, the green and the blue filter to a laser of `GREEN_NM`,
    # relative to that to white light; the green one has 1.
    at_green: Vector = (0.40, 1.0, 0.27)
    # Loss of the colour of daylight by crosstalk between the filters, restored by the camera's
    # colour matrix: colour minus luma is divided, then multiplied by 1 plus this. Daylight is
    # unchanged; a laser, whose single wavelength has crosstalk of its own, gets less red than was
    # recorded, or a negative amount: it darkens red.
    saturation: float = 0.0
    # Middles of the filters in nanometres. Each falls off as a Gaussian.
    peak_nm: Vector = (600.0, GREEN_NM, 460.0)
    # Standard deviation of the green filter, and of the others on the side away from green; on the
    # side towards green their width follows from `at_green`.
    width_nm: float = 45.0

    @property
    def correcting(self) -> FloatArray:
        """Matrix (3, 3) from recorded values, white balanced, to red, green and blue."""
        return (1.0 + self.saturation) * np.eye(3) - self.saturation * np.tile(LUMA, (3, 1))

    @property
    def crosstalk(self) -> FloatArray:
        """Matrix (3, 3) from red, green and blue of a scene to recorded values."""
        return np.asarray(np.linalg.inv(self.correcting))

    def recorded(self, wavelength_nm: float) -> FloatArray:
        """Return the recorded values (3,) of a laser's light under the three filters."""
        if wavelength_nm == GREEN_NM:
            return np.array(self.at_green)
        off = wavelength_nm - np.array(self.peak_nm)
        seen = np.exp(-0.5 * (off / self.width_nm) ** 2)
        for k in (0, 2):
            to_green = GREEN_NM - self.peak_nm[k]
            if off[k] * to_green > 0.0:
                seen[k] = self.at_green[k] ** ((off[k] / to_green) ** 2)
        return np.asarray(seen)

    def laser_colour(self, wavelength_nm: float) -> FloatArray:
        """Return the red, green and blue (3,) of a laser in a scene."""
        return np.asarray(self.correcting @ self.recorded(wavelength_nm))


COLOUR_BALANCED = ColourFilters()
"""Filters of the ideal camera: daylight as it is, and a green laser with a little red and blue."""


# Columns of the sheet table.
SOURCE, NORMAL, CENTRE, SIDE, SIGMA, DIVERGENCE, POWER, REACH = 0, 3, 6, 9, 12, 13, 14, 15
# Colour of the light for the camera, and weights of the water's three bands in its attenuation.
COLOUR, BANDS = 16, 19
_COLUMNS = 22
# Half thickness of a sheet, in sigmas, beyond which it is dark.
CUT = 4.0
N_FAN = 3001
# The fan's edge rolls off over this angle.
_EDGE = np.deg2rad(0.8)
_ON_PLANE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserSource:
    """Source of a laser sheet: place, direction and distribution of its light."""

    # Shape (3,): the fan's origin in `dome`, on the laser's plane, in metres. Behind a window it is
    # the window's source.
    position: FloatArray
    # Shape (3,): unit vector of the fan's middle in `dome`, in the laser's plane (in air, behind a
    # window).
    direction: FloatArray
    # Half the fan's opening in radians (in air, behind a window).
    half_angle: float = float(np.deg2rad(34.0))
    sigma: float = 0.45e-3  # Standard deviation of the sheet's thickness at the source, in metres.
    # Growth of that standard deviation with distance (in the water), in radians.
    divergence: float = 0.75e-3
    # Radiance of a white surface at the sheet's centre, square to the light 0.5 m from the source,
    # in clear water.
    power: float = 10.0
    # In nanometres; decides the response of the colour filters and the attenuation by the water.
    wavelength_nm: float = GREEN_NM


class Sheets(NamedTuple):
    """Laser sheets as tables."""

    table: FloatArray  # Shape (n, 22): see the column constants of this module.
    # Shape (n, N_FAN): relative power over the tangent of the fan angle, from -reach to reach.
    fan: FloatArray
    # Shape (n, N_FAN): distance from the source at which the sheet's middle meets a surface;
    # infinite where none.
    first: FloatArray
    optics: FloatArray  # Shape (n, COLUMNS): the sheets for the kernels of `aqualvs.optics.sheet`.
    # Shape (n, 2): greatest distance of a bent sheet from the plane near it: metres at the window,
    # and metres for every metre from the source.
    stray: FloatArray


def default_sources(rig: Rig) -> tuple[LaserSource, ...]:
    """Return a source for every laser of a rig: beside the dome, aimed forward in its plane."""
    return tuple(_source_on(laser, rig) for laser in rig.lasers)


def _source_on(laser: Laser, rig: Rig) -> LaserSource:
    """Return a source on the plane, near the dome, 10 mm before the dome's centre.

    Behind a window it is the rig's source. It is green if the rig gives no wavelength.
    """
    normal = laser.plane.normal
    forward = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    length = float(np.linalg.norm(forward))
    if length < 0.1:
        raise RigError(
            f"laser {laser.name}: its plane is square to the camera's view, so no stripe can "
            "appear; check the plane's normal in the rig"
        )
    forward /= length
    if laser.window is not None:
        position = sheet_in(laser, rig.n_air, rig.n_water).source
    else:
        foot = normal * laser.plane.offset
        position = foot - (foot[1] - 0.01) / forward[1] * forward
    wavelength_nm = GREEN_NM if laser.wavelength_nm is None else laser.wavelength_nm
    return LaserSource(position=position, direction=forward, wavelength_nm=wavelength_nm)


def pack_sheets(
    rig: Rig, sources: Sequence[LaserSource], filters: ColourFilters = COLOUR_BALANCED
) -> Sheets:
    """Return the tables of a rig's laser sheets that nothing shadows yet, as a camera sees them.

    Raises `RigError` if there is not one source for every laser, or a source is off its laser's
    plane or not that of its laser's window.
    """
    lasers, sheets = rig.lasers, sheets_of(rig)
    if len(sources) != len(lasers):
        raise RigError(f"{len(lasers)} lasers but {len(sources)} sources; give one for each laser")
    table = np.zeros((len(lasers), _COLUMNS))
    fan = np.zeros((len(lasers), N_FAN))
    for i, (laser, source) in enumerate(zip(lasers, sources, strict=True)):
        table[i] = _pack_sheet(laser, sheets[i], source, filters)
        tangents = np.linspace(-table[i, REACH], table[i, REACH], N_FAN)
        past_edge = (np.abs(np.arctan(tangents)) - source.half_angle) / _EDGE
        fan[i] = 1.0 / (1.0 + np.exp(np.clip(8.0 * past_edge, -60.0, 60.0)))
    optics = packed_sheets(rig, rig.camera())
    stray = np.zeros((len(lasers), 2))
    packed = Sheets(table, fan, np.full_like(fan, np.inf), optics, stray)
    for i, sheet in enumerate(sheets):
        if not sheet.is_plane:
            rays, _ = sheet.shine(_fan_directions(packed, i))
            plane = optics[i, START : START + 4]
            off = np.abs(rays.origins @ plane[:3] - plane[3]), np.abs(rays.directions @ plane[:3])
            stray[i] = [np.max(one[rays.valid], initial=0.0) for one in off]
    return packed


def _pack_sheet(
    laser: Laser, sheet: Sheet, source: LaserSource, filters: ColourFilters
) -> FloatArray:
    normal = laser.plane.normal
    off = float(laser.plane.signed_distance(source.position))
    tilt = float(normal @ source.direction)
    if abs(off) > _ON_PLANE or abs(tilt) > _ON_PLANE:
        raise RigError(
            f"laser {laser.name}: its source is {1e3 * off:.3f} mm off its plane or aims "
            f"{np.rad2deg(tilt):.3f} deg out of it; put both in the plane"
        )
    apart = 0.0 if sheet.is_plane else float(np.linalg.norm(source.position - sheet.source))
    if apart > _ON_PLANE:
        raise RigError(
            f"laser {laser.name}: its source is {1e3 * apart:.3f} mm from where its window's "
            "source_mm has it; put both in one place"
        )
    side = np.cross(normal, source.direction)
    shape = [source.sigma, source.divergence, source.power]
    reach = np.tan(min(source.half_angle + 2.0 * _EDGE, np.deg2rad(85.0)))
    light = [filters.laser_colour(source.wavelength_nm), band_shares(source.wavelength_nm)]
    return np.concatenate([source.position, normal, source.direction, side, shape, [reach], *light])


class FanRays(NamedTuple):
    """Rays in a sheet's middle, in the water."""

    # Shape (N_FAN, 3): points of entry into the water, or the source without a window; unit
    # directions.
    origins: FloatArray
    directions: FloatArray
    way: FloatArray  # Shape (N_FAN,): length of the light's way from the source to there.


def fan_rays(rig: Rig, sheets: Sheets, i: int) -> FanRays:
    """Return the rays in a sheet's middle; NaN if the light does not pass the window."""
    directions = _fan_directions(sheets, i)
    sheet = sheet_in(rig.lasers[i], rig.n_air, rig.n_water)
    if sheet.is_plane:
        origins = np.tile(sheets.table[i, SOURCE : SOURCE + 3], (N_FAN, 1))
        return FanRays(origins, directions, np.zeros(N_FAN))
    bent, way = sheet.shine(directions)
    return FanRays(bent.origins, bent.directions, way)


def _fan_directions(sheets: Sheets, i: int) -> FloatArray:
    """Return unit directions (N_FAN, 3) in which a sheet's middle leaves its source."""
    row = sheets.table[i]
    tangents = np.linspace(-row[REACH], row[REACH], N_FAN)[:, None]
    directions: FloatArray = row[CENTRE : CENTRE + 3] + tangents * row[SIDE : SIDE + 3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


@inline_borrowing_kernel
def sheet_coordinates(p: Vec, sheets: Sheets, i: int) -> tuple[float, float, float, float]:
    """Return distance off the sheet, length of the light's way, place in the fan, sigma.

    The place in the fan is a fractional index of `Sheets.fan`, negative outside the fan.
    """
    table = sheets.table
    rel = minus(p, row3(table, i, SOURCE))
    off, distance = dot(rel, row3(table, i, NORMAL)), 0.0
    bent = sheets.optics[i, WINDOWED] != 0.0
    # Greatest ratio of the light's way to the straight line.
    bent_way = 1.1
    if bent:
        reach = np.sqrt(dot(rel, rel))
        wide = CUT * (table[i, SIGMA] + table[i, DIVERGENCE] * reach)
        wide += sheets.stray[i, 0] + bent_way * sheets.stray[i, 1] * reach
        start = row3(sheets.optics, i, START)
        # Few points are near a sheet: a dot product rejects the others faster than Snell's law.
        if abs(dot(p, start) - sheets.optics[i, START + 3]) > wide:
            return off, 0.0, -1.0, 1.0
        off, rel, above = through_window(p, sheets, i)
        if not above > 0.0:
            return off, 0.0, -1.0, 1.0
        after = minus(minus(p, row3(table, i, SOURCE)), rel)
        distance = np.sqrt(dot(after, after))
    forward, lateral = dot(rel, row3(table, i, CENTRE)), dot(rel, row3(table, i, SIDE))
    reach = table[i, REACH]
    if forward <= 0.0 or abs(lateral) >= reach * forward:
        return off, 0.0, -1.0, 1.0
    place = (lateral / (forward * reach) + 1.0) * 0.5 * (N_FAN - 1)
    distance += np.sqrt(forward * forward + lateral * lateral)
    return off, distance, place, table[i, SIGMA] + table[i, DIVERGENCE] * distance


@inline_borrowing_kernel
def through_window(p: Vec, sheets: Sheets, i: int) -> tuple[float, Vec, float]:
    """Return distance off a bent sheet, the way from the source to its window, height above that.

    The way is that of the light that reaches the point; it exists if the height is positive.
    """
    off, x, y, z, above = crossing(sheets.optics[i], p[0], p[1], p[2])
    return off, (x, y, z), above


@inline_borrowing_kernel
def peak_irradiance(
    distance: float, sigma: float, place: float, attenuation: float, sheets: Sheets, i: int
) -> float:
    """Return the irradiance in a sheet's middle, spread by the fan and dimmed by the water."""
    row = sheets.table[i]
    # `LaserSource.power` is stated at this distance.
    reference_m = 0.5
    reference = reference_m * (row[SIGMA] + reference_m * row[DIVERGENCE])
    spread = reference / (distance * sigma)
    k = int(place)
    a = place - k
    fan = sheets.fan[i, k] * (1.0 - a) + sheets.fan[i, min(k + 1, N_FAN - 1)] * a
    return float(row[POWER] * spread * fan * np.exp(-attenuation * distance))


@inline_borrowing_kernel
def laser_attenuation(attenuation: Vec, sheets: Sheets, i: int) -> float:
    """Return the attenuation of a sheet's light per metre, from that of the three bands."""
    return dot(row3(sheets.table, i, BANDS), attenuation)


@inline_borrowing_kernel
def add_colour(seen: Vec, light: float, sheets: Sheets, i: int) -> Vec:
    """Return red, green and blue with a sheet's light added."""
    return along(seen, row3(sheets.table, i, COLOUR), light)


def light_on_points(points: FloatArray, sheets: Sheets, attenuation: Vec) -> FloatArray:
    """Return the laser light on free-floating points, shape (n, 3) in, (n, 3) out.

    Parameters
    ----------
    points : array, shape (n, 3)
        In `dome`, in metres.
    sheets : Sheets
        With the distances at which surfaces end them.
    attenuation : (float, float, float)
        Of the water per metre, for red, green and blue.
    """
    light = np.zeros((len(points), 3))
    _light_on_points(np.ascontiguousarray(points), sheets, attenuation, light)
    return light


@borrowing_kernel
def _light_on_points(points: FloatArray, sheets: Sheets, attenuation: Vec, out: FloatArray) -> None:
    for k in range(points.shape[0]):
        p, seen = row3(points, k, 0), (0.0, 0.0, 0.0)
        for i in range(sheets.table.shape[0]):
            off, distance, place, sigma = sheet_coordinates(p, sheets, i)
            if place < 0.0 or distance > sheets.first[i, int(place + 0.5)]:
                continue
            dimmed = laser_attenuation(attenuation, sheets, i)
            peak = peak_irradiance(distance, sigma, place, dimmed, sheets, i)
            seen = add_colour(seen, peak * np.exp(-0.5 * (off / sigma) ** 2), sheets, i)
        out[k, 0], out[k, 1], out[k, 2] = seen
