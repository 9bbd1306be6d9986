"""Simulated cameras by name: processing of the picture, from the lens to the recorded frame.

`ideal` is a camera without faults: daylight as it is, a tone curve, noise, H.264 at high quality
(`spread`, `expose`). The others add what real pictures of laser lines have and rendered ones lack:
filters that let a green laser into red and blue, cores that clip to cyan and white inside a green
halo, a mosaic of colours, sharpening, exposure and white balance that drift, and a low bit rate.

The order of the steps is that of a camera: lens, exposure, noise, full scale of the pixels, mosaic,
white balance, colour correction, tone curve, sharpening, chroma, compression. Input is the radiance
before the lens, output the grey levels of the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, combine, row3
from aqualvs.optics.camera import Camera
from aqualvs.simulation.lasers import COLOUR_BALANCED, LUMA, ColourFilters
from aqualvs.simulation.scene import CameraSensor, Scene, Vector, WaterOptics
from aqualvs.simulation.video import Compression


def spread(
    radiance: NDArray[np.float32], water: WaterOptics, sensor: CameraSensor
) -> NDArray[np.float32]:
    """Blur by the lens, and send the forward-scattered fraction into a wide halo.

    This is before saturation: a stripe far above full scale keeps its broad halo.
    """
    sharp = radiance
    if sensor.defocus_px > 0.0:
        sharp = cv2.GaussianBlur(radiance, (0, 0), sensor.defocus_px)
    if water.forward_scatter <= 0.0:
        return sharp
    height, width = radiance.shape[:2]
    # Reduction of the picture on which the wide halo, which has no detail, is computed.
    shrink = 4
    small = cv2.resize(
        radiance, (-(-width // shrink), -(-height // shrink)), interpolation=cv2.INTER_AREA
    )
    small = cv2.GaussianBlur(small, (0, 0), water.halo_px / shrink)
    halo = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(
        cv2.addWeighted(sharp, 1.0 - water.forward_scatter, halo, water.forward_scatter, 0.0)
    )


def expose(
    radiance: NDArray[np.float32], sensor: CameraSensor, rng: np.random.Generator | None
) -> NDArray[np.uint8]:
    """Apply gain, noise, full scale, gamma and 8 bits; without `rng` there is no noise."""
    signal = radiance * np.float32(sensor.gain)
    if rng is not None:
        variance = np.float32(sensor.shot_noise) * np.maximum(signal, 0.0)
        variance += np.float32(sensor.read_noise**2)
        signal = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, dtype=np.float32)
    levels = np.clip(signal, 0.0, 1.0) * np.float32(_CURVE_STEPS)
    return np.asarray(_tone_curve(sensor.gamma)[(levels + 0.5).astype(np.uint16)])


_CURVE_STEPS = 16383


def _tone_curve(gamma: float) -> NDArray[np.uint8]:
    """Return the grey level for every one of 2^14 equal steps of radiance."""
    linear = np.arange(_CURVE_STEPS + 1) / _CURVE_STEPS
    return np.asarray(np.rint(255.0 * linear ** (1.0 / gamma)), dtype=np.uint8)


Rgb = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Drift of a control loop: a slow swing and a faster, smaller one."""

    swing: float = 0.0  # Relative amplitude of the gain, 0.1 for 10 %.
    period_s: float = 10.0  # Of the slow swing, in seconds.
    phase: float = 0.0  # Of the slow swing at time 0, in turns.

    def at(self, t: float) -> float:
        """Return the factor on the gain at a time in seconds."""
        turns = t / self.period_s + self.phase
        slow, fast = np.sin(2.0 * np.pi * turns), np.sin(2.0 * np.pi * 3.7 * turns)
        return float(1.0 + self.swing * (0.8 * slow + 0.2 * fast))


@dataclass(frozen=True, slots=True, kw_only=True)
class Development:
    """Processing between the lens and the recorder of a camera that is not ideal."""

    # Radiance of a white surface in the light of the camera's own lamps, which is even over the
    # whole view and added to the daylight of the water.
    lamp: Vector = (0.0, 0.0, 0.0)
    defocus_px: float = 0.75  # Standard deviation of the blur of lens and pixels, in pixels.
    flare: float = 0.02  # Share of the light that the lens spreads over a halo.
    flare_px: float = 12.0  # Standard deviation of that halo, in pixels.
    exposure: float = 0.22  # Mean grey (0 to 1, linear) that automatic exposure aims at.
    gains: tuple[float, float] = (0.25, 4.0)  # Least and greatest gain of automatic exposure.
    # Drift of the overall gain and of the balance of red and of blue.
    exposure_drift: Drift = Drift()
    red_drift: Drift = Drift()
    blue_drift: Drift = Drift()
    # Strength of automatic white balance towards a grey mean of the picture, 0 to 1.
    white_balance: float = 0.6
    read_noise: float = 0.004  # Standard deviation in the dark, of full scale at gain 1.
    # Variance of the noise per unit of light, of full scale squared at gain 1.
    shot_noise: float = 1.5e-4
    # One colour a pixel (Bayer, red top left), the others interpolated between neighbours.
    mosaic: bool = True
    gamma: float = 2.0  # Grey level = light**(1 / gamma), before `contrast`.
    # Strength of an S curve over that, 0 to 1: darker shadows, lights that reach white earlier.
    contrast: float = 0.0
    black: float = 0.0  # Grey level of no light, of full scale.
    sharpening: float = 0.0  # Strength of the unsharp mask on luma.
    # Its standard deviations along x and y, in pixels; 0 leaves a direction alone.
    sharpening_px: tuple[float, float] = (1.0, 1.0)
    # Blur of chroma along x and y, in pixels: noise reduction, or bandwidth.
    chroma_px: tuple[float, float] = (0.0, 0.0)

    def develop(
        self,
        radiance: Rgb,
        water: WaterOptics,
        filters: ColourFilters,
        t: float,
        rng: np.random.Generator | None,
    ) -> NDArray[np.uint8]:
        """Return the picture before it is compressed; see `SimulatedCamera.picture`.

        `water`: its halo is used. `filters`: of the sensor.
        """
        lens = CameraSensor(defocus_px=self.defocus_px)
        light = spread(radiance, water, lens)
        flare = WaterOptics(forward_scatter=self.flare, halo_px=self.flare_px)
        light = spread(light, flare, replace(lens, defocus_px=0.0))
        raw = _mixed(light, filters.crosstalk)
        gain, balance = self._gains(raw, t)
        raw = self._read_out(raw, gain, rng)
        if self.mosaic:
            raw = _through_mosaic(raw)
        # The least of the three gains is 1, so that a clipped pixel is white.
        raw = np.minimum(raw * (balance / balance.min()), 1.0).astype(np.float32)
        raw = np.clip(_mixed(raw, filters.correcting), 0.0, 1.0)
        return self._finish(raw)

    def _gains(self, raw: Rgb, t: float) -> tuple[float, FloatArray]:
        """Return the gain of all colours and those of red, green and blue, from the mean picture.

        Light above full scale counts as full scale, as in an exposure meter.
        """
        lit = raw.max(axis=2) > 0.0
        means = np.minimum(raw[lit], 1.0).mean(axis=0) if lit.any() else np.ones(3)
        means = np.maximum(means, 1e-3).astype(np.float64)
        gain = np.clip(self.exposure / means.mean(), *self.gains) * self.exposure_drift.at(t)
        balance = (means[1] / means) ** self.white_balance
        balance *= [self.red_drift.at(t), 1.0, self.blue_drift.at(t)]
        return float(gain), balance

    def _read_out(self, raw: Rgb, gain: float, rng: np.random.Generator | None) -> Rgb:
        """Return light times gain with its noise, cut at the full scale of the pixels."""
        if rng is not None:
            variance = np.maximum(raw, 0.0) * np.float32(self.shot_noise)
            variance += np.float32(self.read_noise**2)
            noise = np.sqrt(variance) * rng.standard_normal(raw.shape, dtype=np.float32)
            raw = np.asarray(raw + noise, dtype=np.float32)
        return np.asarray(np.clip(raw * np.float32(gain), 0.0, 1.0), dtype=np.float32)

    def _finish(self, linear: Rgb) -> NDArray[np.uint8]:
        """Apply the tone curve, sharpen the luma, blur the chroma, and round to 8 bits."""
        grey = linear ** np.float32(1.0 / self.gamma)
        grey += np.float32(self.contrast) * (grey * grey * (3.0 - 2.0 * grey) - grey)
        grey = np.asarray(self.black + (1.0 - self.black) * grey, dtype=np.float32)
        luma = cv2.transform(grey, LUMA[None].astype(np.float32))
        chroma = _blurred(grey - luma[..., None], self.chroma_px)
        if self.sharpening > 0.0:
            luma = luma + np.float32(self.sharpening) * (luma - _blurred(luma, self.sharpening_px))
        return np.asarray(np.rint(255.0 * np.clip(chroma + luma[..., None], 0.0, 1.0)), np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCamera:
    """Camera for simulated pictures."""

    name: str  # Name for `aqualvs simulate --camera`.
    filters: ColourFilters = COLOUR_BALANCED  # Response of its sensor to daylight and lasers.
    development: Development | None = None  # None uses the scene's own `CameraSensor` only.
    recording: Compression = field(default_factory=Compression)  # Compression of its videos.
    # JPEG quality (0 to 100) of its single pictures; None writes them as PNG.
    still_quality: int | None = None

    def light(self, scene: Scene) -> Scene:
        """Return a scene with the camera's own lamps on."""
        if self.development is None or not any(self.development.lamp):
            return scene
        red, green, blue = np.add(scene.water.ambient, self.development.lamp).tolist()
        ambient = (red, green, blue)
        return replace(scene, water=replace(scene.water, ambient=ambient))

    def picture(
        self,
        radiance: Rgb,
        water: WaterOptics,
        sensor: CameraSensor,
        t: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3), red, green, blue, before it is compressed.

        Parameters
        ----------
        radiance : float32 array, shape (height, width, 3)
            Before the lens, rendered with this camera's `filters`; black where no light comes
            through.
        water : WaterOptics
            Its halo.
        sensor : CameraSensor
            The scene's; used by the ideal camera only.
        t : float
            Time in seconds, with which exposure and white balance drift.
        rng : Generator, optional
            Source of noise; without it there is none.
        """
        if self.development is None:
            return expose(spread(radiance, water, sensor), sensor, rng)
        return self.development.develop(radiance, water, self.filters, t, rng)


def _mixed(image: Rgb, matrix: FloatArray) -> Rgb:
    return np.asarray(cv2.transform(image, matrix.astype(np.float32)))


def _blurred(image: Rgb, sigmas: tuple[float, float]) -> Rgb:
    """Return a picture blurred along x and y; a sigma of 0 leaves a direction alone."""
    if not any(sigmas):
        return image
    x, y = map(_bell, sigmas)
    return np.asarray(cv2.sepFilter2D(image, -1, x, y))


def _bell(sigma: float) -> NDArray[np.float32]:
    if sigma <= 0.0:
        return np.ones(1, np.float32)
    return np.asarray(cv2.getGaussianKernel(2 * int(np.ceil(3.0 * sigma)) + 1, sigma, cv2.CV_32F))


def _through_mosaic(raw: Rgb) -> Rgb:
    """Keep one colour a pixel, and interpolate the others (OpenCV's bilinear demosaicing)."""
    # Full scale of the sensor's converter in counts (12 bits).
    full_scale = 4095.0
    counts = np.rint(raw * np.float32(full_scale)).astype(np.uint16)
    mosaic = counts[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = counts[::2, ::2, 0], counts[1::2, 1::2, 2]
    # OpenCV names the pattern by the second row's second and third pixel.
    colours = cv2.demosaicing(mosaic, cv2.COLOR_BayerBG2RGB)
    return np.asarray(colours.astype(np.float32) / np.float32(full_scale))


IDEAL = SimulatedCamera(name="ideal")
"""No faults but blur, noise and a full scale; H.264 at high quality."""

# Cheap USB camera: crosstalk, sharpening, drifting white balance and exposure, MJPEG.
_WEBCAM = SimulatedCamera(
    name="webcam",
    filters=ColourFilters(at_green=(0.02, 1.0, 0.63), saturation=0.5),
    development=Development(
        defocus_px=0.7,
        flare=0.015,
        exposure=0.20,
        exposure_drift=Drift(swing=0.12, period_s=7.0),
        red_drift=Drift(swing=0.10, period_s=11.0, phase=0.2),
        blue_drift=Drift(swing=0.08, period_s=17.0, phase=0.6),
        white_balance=0.7,
        read_noise=0.006,
        shot_noise=3e-4,
        gamma=2.0,
        contrast=0.25,
        sharpening=0.9,
        sharpening_px=(1.2, 1.2),
        chroma_px=(1.0, 1.0),
    ),
    recording=Compression(codec="mjpeg", jpeg_quality=80),
    still_quality=80,
)

# Action camera with lamps: strong tone curve, white cores in a halo, H.264 at a low rate.
_ACTION = SimulatedCamera(
    name="action",
    filters=ColourFilters(at_green=(0.37, 1.0, 0.76), saturation=0.6),
    development=Development(
        lamp=(0.30, 0.30, 0.28),
        defocus_px=0.6,
        flare=0.08,
        flare_px=6.0,
        exposure=0.15,
        exposure_drift=Drift(swing=0.06, period_s=9.0),
        red_drift=Drift(swing=0.05, period_s=13.0, phase=0.4),
        blue_drift=Drift(swing=0.05, period_s=19.0, phase=0.1),
        white_balance=0.8,
        read_noise=0.004,
        shot_noise=2e-4,
        gamma=2.2,
        contrast=0.7,
        sharpening=0.7,
        sharpening_px=(0.9, 0.9),
        chroma_px=(0.8, 0.8),
    ),
    recording=Compression(crf=28),
    still_quality=85,
)

# Analogue video, captured: soft, narrow chroma, noise, edges overshoot sideways, H.264.
_PAL = SimulatedCamera(
    name="pal",
    filters=ColourFilters(at_green=(0.34, 1.0, 0.55), saturation=0.2),
    development=Development(
        defocus_px=0.9,
        flare=0.03,
        exposure=0.14,
        exposure_drift=Drift(swing=0.05, period_s=8.0),
        red_drift=Drift(swing=0.04, period_s=15.0),
        blue_drift=Drift(swing=0.04, period_s=21.0, phase=0.5),
        white_balance=0.6,
        read_noise=0.010,
        shot_noise=4e-4,
        mosaic=False,
        gamma=1.8,
        contrast=0.1,
        black=0.04,
        sharpening=1.0,
        sharpening_px=(1.6, 0.0),
        chroma_px=(3.0, 0.7),
    ),
    recording=Compression(crf=23),
    still_quality=92,
)

CAMERAS: Mapping[str, SimulatedCamera] = MappingProxyType(
    {camera.name: camera for camera in (IDEAL, _WEBCAM, _ACTION, _PAL)}
)
"""All cameras by name."""


def simulated_camera(name: str) -> SimulatedCamera:
    """Return a camera by its name; raise `OptionError` if there is none of that name."""
    if name not in CAMERAS:
        raise OptionError(f"--camera {name}: no such camera; choose one of {', '.join(CAMERAS)}")
    return CAMERAS[name]


class CornerRays(NamedTuple):
    """Rays through the corners of the pixels, shape (height + 1, width + 1, ...)."""

    origins: FloatArray
    directions: FloatArray
    valid: BoolArray

    def only(self, where: BoolArray) -> "CornerRays":
        """Return the same rays, valid only at the corners of some pixels (height, width)."""
        wanted = np.zeros_like(self.valid)
        for rows in (slice(None, -1), slice(1, None)):
            for columns in (slice(None, -1), slice(1, None)):
                wanted[rows, columns] |= where
        return self._replace(valid=self.valid & wanted)


@inline_borrowing_kernel
def sees_out(valid: BoolArray, row: int, column: int) -> bool:
    """Return whether all four corners of a pixel see out."""
    return bool(
        valid[row, column]
        and valid[row, column + 1]
        and valid[row + 1, column]
        and valid[row + 1, column + 1]
    )


@inline_borrowing_kernel
def between_corners(corners: FloatArray, row: int, column: int, x: float, y: float) -> Vec:
    """Return the bilinear value between the corners of a pixel, x and y in 0..1."""
    a, b = row3(corners[row], column, 0), row3(corners[row], column + 1, 0)
    c, e = row3(corners[row + 1], column, 0), row3(corners[row + 1], column + 1, 0)
    zero = (0.0, 0.0, 0.0)
    top = combine(a, 1.0 - x, b, x, zero, 0.0)
    return combine(top, 1.0 - y, combine(c, 1.0 - x, e, x, zero, 0.0), y, zero, 0.0)


def corner_rays(camera: Camera) -> CornerRays:
    """Trace the corners of all pixels through the housing, if there is one."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    return CornerRays(
        np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions), rays.valid
    )
